"""The kinematic chain of a robot, read from its MuJoCo model with all joints at zero."""

from functools import cache
from typing import Final

import mujoco
import numpy as np
import numpy.typing as npt

from common.physics.chain import JOINTS, Chain
from common.robot.description import RobotError, describe
from common.robot.model import SURROUNDINGS, load_model

Array = npt.NDArray[np.float64]

_VISUAL: Final = 2  # group of geoms that only pictures show
_PARALLEL: Final = 1e-6


def _axis(name: str, joint: str, axis: Array) -> tuple[int, float]:
    index = int(np.argmax(np.abs(axis)))
    if abs(abs(axis[index]) - 1.0) > _PARALLEL:
        raise RobotError(
            f"robot {name}: joint {joint} has axis {np.round(axis, 3).tolist()} with all joints at zero; allowed: an "
            "axis of the world"
        )
    return index, float(np.sign(axis[index]))


def _beyond(
    items: list[Array], anchors: Array, is_hinge: npt.NDArray[np.bool_], axis: Array, ranges: Array
) -> float:
    """Return a bound of the distance between a hinge's axis and points that it moves.

    Args:
        items: Points as (joint that moves them, x, y, z with all joints at zero, radius), those of the hinge and on.
        anchors: (n, 3) the hinge's position and those of the joints after it.
        is_hinge: (n,) of these joints.
        axis: (3,) of the hinge.
        ranges: (n,) largest movement of these joints if they are slides.
    """
    steps = np.diff(anchors, axis=0)
    lengths = [float(np.linalg.norm(s - (s @ axis) * axis if k == 0 else s)) for k, s in enumerate(steps)]
    slid = np.where(is_hinge, 0.0, ranges)
    farthest = 0.0
    for joint, x, y, z, radius in items:
        k = int(joint)
        own = np.array([x, y, z]) - anchors[k]
        own = own - (own @ axis) * axis if k == 0 else own
        path = sum(lengths[:k]) + float(slid[1 : k + 1].sum()) + float(np.linalg.norm(own)) + radius
        farthest = max(farthest, path)
    return farthest


def _ball_geoms(model: mujoco.MjModel, racket: str) -> list[int]:
    """Return the robot's geoms that the ball can hit, without its racket's."""
    other = (*SURROUNDINGS, racket)
    return [
        geom
        for geom in range(model.ngeom)
        if model.geom(geom).name not in other and model.geom_group[geom] != _VISUAL
    ]


def _capsules(
    name: str, model: mujoco.MjModel, data: mujoco.MjData, racket: str, owner: dict[int, int]
) -> Array:
    """Return the robot's parts that the ball can hit: joint, start, end, radius (n, 8), with all joints at zero."""
    rows = []
    for geom in _ball_geoms(model, racket):
        label, kind = model.geom(geom).name, model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = model.geom_size[geom, 1]
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            half = 1e-9  # a capsule of no length has no direction
        else:
            raise RobotError(
                f"robot {name}: geom {label or geom} is neither capsule nor sphere; allowed besides: the racket's "
                f"cylinder, and any geom of group {_VISUAL}, which is only drawn"
            )
        along = data.geom_xmat[geom].reshape(3, 3)[:, 2] * half
        centre = data.geom_xpos[geom]
        rows.append(
            [owner[model.geom_bodyid[geom]], *(centre - along), *(centre + along), model.geom_size[geom, 0]]
        )
    rows.sort(key=lambda row: float(row[0]))
    return np.array(rows).reshape(-1, 8)


def _owners(model: mujoco.MjModel) -> dict[int, int]:
    """Return for every body the last joint of the chain that moves it; -1: none."""
    owner = {0: -1}
    for body in range(1, model.nbody):
        owner[body] = owner[model.body_parentid[body]]
        for joint in range(JOINTS):
            if model.jnt_bodyid[joint] == body:
                owner[body] = joint
    return owner


def capsule_names(name: str) -> list[str]:
    """Return the geoms of a robot that the ball can hit, without its racket's."""
    model = load_model(name)
    return [model.geom(geom).name for geom in _ball_geoms(model, describe(name).racket)]


@cache
def chain_of(name: str) -> Chain:
    """Return the kinematic chain of a robot.

    Raises:
        RobotError: The robot's model is not a chain of seven joints along the world's axes, with a racket at its end.
    """
    robot, model = describe(name), load_model(name)
    names = [joint.name for joint in robot.joint]
    found = [model.joint(j).name for j in range(model.njnt)]
    if found != names:
        raise RobotError(f"robot {name}: the model has joints {found}; allowed: those of its table, {names}")
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    owner = _owners(model)
    axes = [_axis(name, joint, data.xaxis[k]) for k, joint in enumerate(names)]
    is_hinge = model.jnt_type[:JOINTS] == mujoco.mjtJoint.mjJNT_HINGE.value
    anchors = np.array(data.xanchor[:JOINTS])
    before = np.vstack([np.zeros(3), anchors[:-1]])
    try:
        geom, site = model.geom(robot.racket).id, model.site(robot.racket).id
    except KeyError:
        raise RobotError(
            f"robot {name}: racket {robot.racket!r}; allowed: the name of a geom and of a site in its model"
        ) from None
    if (
        model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CYLINDER
        or owner[model.geom_bodyid[geom]] != JOINTS - 1
    ):
        raise RobotError(f"robot {name}: geom {robot.racket}; allowed: a cylinder that the last joint moves")
    centre = np.array(data.site_xpos[site])
    radius, half = model.geom_size[geom, :2]
    parts = _capsules(name, model, data, robot.racket, owner)
    rim = float(np.hypot(radius, half))
    points = [[row[0], *row[1:4], row[7]] for row in parts] + [[row[0], *row[4:7], row[7]] for row in parts]
    points.append([JOINTS - 1, *centre, rim])
    travel = np.abs(np.array([joint.range for joint in robot.joint])).max(axis=1)
    reach = np.ones(JOINTS)
    for k in np.flatnonzero(is_hinge):
        items = [np.array([p[0] - k, *p[1:]]) for p in points if p[0] >= k]
        axis = np.eye(3)[axes[k][0]]
        reach[k] = _beyond(items, anchors[k:], is_hinge[k:], axis, travel[k:])
    slides = int(np.argmax(is_hinge)) if is_hinge.any() else JOINTS
    hub_joint = slides
    if slides + 1 < JOINTS and is_hinge[slides + 1]:
        step, axis = anchors[slides + 1] - anchors[slides], np.eye(3)[axes[slides][0]]
        if np.linalg.norm(np.cross(step, axis)) < 1e-9:
            hub_joint = slides + 1  # on the first hinge's axis: that one does not move it
    moved = [np.array([max(p[0] - hub_joint, 0), *p[1:]]) for p in points if p[0] >= slides]
    hub_reach = _beyond(moved, anchors[hub_joint:], is_hinge[hub_joint:], np.zeros(3), travel[hub_joint:])
    origin = np.array([anchors[int(j)] if j >= 0 else np.zeros(3) for j in parts[:, 0]]).reshape(-1, 3)
    hub = anchors[hub_joint] - (anchors[slides - 1] if slides else np.zeros(3))
    return Chain(
        joints=np.column_stack([is_hinge.astype(np.float64), *np.array(axes).T, reach, anchors - before]),
        capsules=np.column_stack([parts[:, 0], parts[:, 1:4] - origin, parts[:, 4:7] - origin, parts[:, 7]]),
        racket=np.concatenate(
            [centre - anchors[-1], data.site_xmat[site].reshape(3, 3).T.ravel(), [radius, half]]
        ),
        slides=slides,
        hub=(float(hub[0]), float(hub[1]), float(hub[2])),
        hub_reach=hub_reach,
    )
