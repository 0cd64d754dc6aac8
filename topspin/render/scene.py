"""Drawing one moment of a rally: robot, ball, trail, target, spin; colours and cameras."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from common.physics.constants import BALL_RADIUS, GRID_STEP
from topspin.render.gl import Canvas, Image
from topspin.render.hall import BALL, load_hall
from topspin.render.replay import BallPath, Moment

Array = npt.NDArray[np.float64]
CameraName = Literal["side", "behind", "target", "follow"]


class TrailColour(NamedTuple):
    """How a state of the ball is drawn and named."""

    rgb: tuple[float, float, float]
    label: str


# Okabe and Ito's colours, for any colour vision; each is visible on the table's blue
TRAIL: Final[dict[int, TrailColour]] = {
    0: TrailColour((0.35, 0.75, 0.98), "coming"),  # tau_01
    1: TrailColour((0.95, 0.90, 0.25), "bounced"),  # tau_12
    2: TrailColour((0.90, 0.38, 0.05), "hit by the robot"),  # tau_23
    3: TrailColour((0.90, 0.55, 0.78), "landed"),  # tau_30
    4: TrailColour((0.62, 0.60, 0.95), "served"),  # tau_s0
}
SPIN_RGB: Final = (1.0, 1.0, 1.0)
TARGET_RGB: Final = (0.0, 0.72, 0.52)

_TRAIL_RADIUS = 0.0075  # [m]
_TARGET_RADIUS = 0.10  # [m]
_CASTS_NO_SHADOW = mujoco.mjtCatBit.mjCAT_DECOR.value
_OUT_OF_SIGHT = -50.0  # [m] far below the floor
_FAINTEST = 0.16  # [-] opacity of the first ghost
_STRIDE = 3  # grid steps per segment of the trail
_SPIN_LENGTH = (0.07, 0.0012)  # length of the arrow: [m], and per rate of spin [m s/rad]
_CAPSULE, _ARROW = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_ARROW
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera around ``look_at``, as MuJoCo's free camera."""

    look_at: tuple[float, float, float]  # [m]
    distance: float  # [m]
    azimuth_deg: float  # of the direction of view; 90 looks along y
    elevation_deg: float  # of the direction of view; negative looks down


CAMERAS: Final[dict[CameraName, Camera]] = {
    "side": Camera((-0.44, 0.0, 0.09), 4.25, 101.0, -18.0),
    "behind": Camera((-0.45, 0.0, -0.05), 3.5, 12.0, -22.0),
    "target": Camera((-0.25, 0.0, -0.10), 3.7, 160.0, -20.0),
    "follow": Camera((0.0, 0.0, 0.0), 2.3, 112.0, -14.0),
}
FIELD_OF_VIEW_DEG: Final = 38.0  # from bottom to top


def corners_of(trail: BallPath) -> npt.NDArray[np.int64]:
    """Return which points of a trail are drawn: its ends, its touches, and every third of the others."""
    index = np.arange(len(trail.time))
    is_drawn = index % _STRIDE == 0
    is_drawn[[0, -1]] = True
    turns = np.flatnonzero(~np.isclose(trail.time / GRID_STEP, np.rint(trail.time / GRID_STEP), atol=1e-6))
    changes = np.flatnonzero(np.diff(trail.state))
    is_drawn[turns] = is_drawn[changes] = True
    return np.flatnonzero(is_drawn)


class Painter:
    """Draws moments; close it, or use it in a ``with``.

    Args:
        width: Picture's width [pixels].
        height: Picture's height [pixels].
        robot: Its name.
    """

    def __init__(self, width: int, height: int, robot: str = "rails") -> None:
        self._model = load_hall(robot)
        self._model.vis.global_.fovy = FIELD_OF_VIEW_DEG
        self._data = mujoco.MjData(self._model)
        self._ball = self._model.body(BALL).mocapid[0]
        # From the body of its first hinge on all bodies are the arm, except the ball
        hinges = self._model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        self._arm = int(self._model.jnt_bodyid[hinges][0]) if hinges.any() else self._model.nbody
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0  # marks for sensors, not visible objects
        self._canvas = Canvas(self._model, width, height)
        self._canvas.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True

    def paint(
        self, moment: Moment, camera: Camera, width: int = 0, height: int = 0, shadows: bool = True
    ) -> Image:
        """Return a picture of ``moment`` (height, width, 3), of the painter's size unless a smaller one is given."""
        model, data, scene = self._model, self._data, self._canvas.scene
        data.mocap_pos[self._ball] = moment.ball_pos
        data.mocap_quat[self._ball] = moment.ball_turn
        self._pose(moment.joints)
        eye = mujoco.MjvCamera()
        eye.lookat[:] = camera.look_at
        eye.distance, eye.azimuth, eye.elevation = camera.distance, camera.azimuth_deg, camera.elevation_deg
        mujoco.mjv_updateScene(model, data, self._options, None, eye, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE.value:
                geom.category = _CASTS_NO_SHADOW  # otherwise the floor has patches of its own shadow
        for k, joints in enumerate(moment.ghosts):
            self._add_ghost(joints, _FAINTEST + 0.12 * k)
        decorate(scene, moment)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        return self._canvas.paint(width or self._canvas.width, height or self._canvas.height)

    def project(self, points: Array) -> Array:
        """Return the points (n, 3) [m] in the last picture: columns and rows (n, 2) [pixels]."""
        eye, other = self._canvas.scene.camera[0], self._canvas.scene.camera[1]  # left and right
        forward, up = np.array(eye.forward, np.float64), np.array(eye.up, np.float64)
        right = np.cross(forward, up)
        offset = np.atleast_2d(points) - 0.5 * (
            np.array(eye.pos, np.float64) + np.array(other.pos, np.float64)
        )
        depth = offset @ forward
        per_pixel = 2.0 * np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2.0) / self._canvas.height
        columns = 0.5 * self._canvas.width + offset @ right / depth / per_pixel
        rows = 0.5 * self._canvas.height - offset @ up / depth / per_pixel
        return np.stack((columns, rows), axis=1)

    def close(self) -> None:
        """Free the graphics memory."""
        self._canvas.close()

    def __enter__(self) -> "Painter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _pose(self, joints: Array) -> None:
        self._data.qpos[:7] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)  # it places lights and cameras
        mujoco.mj_camlight(self._model, self._data)

    def _add_ghost(self, joints: Array, opacity: float) -> None:
        scene = self._canvas.scene
        self._pose(joints)
        first = scene.ngeom
        mujoco.mjv_addGeoms(
            self._model,
            self._data,
            self._options,
            mujoco.MjvPerturb(),
            mujoco.mjtCatBit.mjCAT_DYNAMIC.value,
            scene,
        )
        for geom in scene.geoms[first : scene.ngeom]:
            geom.category = _CASTS_NO_SHADOW
            geom.rgba[3] *= opacity
            if self._model.geom_bodyid[geom.objid] < self._arm:
                geom.pos[2] = _OUT_OF_SIGHT  # geoms can't be removed from a scene


def decorate(scene: mujoco.MjvScene, moment: Moment) -> None:
    """Add target, trail, landing and spin to a scene; where it is full, the rest is left out."""
    for radius, height, rgb in (
        (_TARGET_RADIUS, 0.0020, TARGET_RGB),
        (0.75 * _TARGET_RADIUS, 0.0030, (1.0, 1.0, 1.0)),
        (0.40 * _TARGET_RADIUS, 0.0040, TARGET_RGB),
    ):
        _add_disc(scene, moment.target, radius, height, rgb)
    if moment.trail is not None:
        _add_trail(scene, moment.trail)
    if moment.landing is not None and np.isfinite(moment.landing).all():
        _add_disc(scene, moment.landing, 0.022, 0.0050, TRAIL[3].rgb)
    _add_spin(scene, moment.ball_pos, moment.ball_spin)


def _add_trail(scene: mujoco.MjvScene, trail: BallPath) -> None:
    for start, end in pairwise(corners_of(trail)):
        rgb = TRAIL[int(trail.state[end])].rgb
        _add_line(scene, _CAPSULE, _TRAIL_RADIUS, trail.pos[start], trail.pos[end], rgb)


def _add_disc(
    scene: mujoco.MjvScene, centre: Array, radius: float, height: float, rgb: tuple[float, float, float]
) -> None:
    """Add a flat disc on the table, its top ``height`` [m] above the table's."""
    geom = _next_geom(scene)
    if geom is None:
        return
    size, pos = np.array([radius, height / 2, 0.0]), np.array([centre[0], centre[1], height / 2])
    colour = np.array([*rgb, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, _CYLINDER.value, size, pos, np.eye(3).ravel(), colour)
    geom.emission, geom.specular = 0.1, 0.0


def _add_spin(scene: mujoco.MjvScene, pos: Array, spin: Array) -> None:
    """Add the spin's axis as an arrow: the ball turns around it by the right-hand rule."""
    rate = float(np.linalg.norm(spin))
    if rate < 1.0:
        return
    axis = spin / rate
    length = BALL_RADIUS + _SPIN_LENGTH[0] + _SPIN_LENGTH[1] * rate
    _add_line(scene, _ARROW, 0.004, pos - 0.4 * length * axis, pos + length * axis, SPIN_RGB)


def _add_line(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    width: float,
    start: Array,
    end: Array,
    rgb: tuple[float, float, float],
) -> None:
    geom = _next_geom(scene)
    if geom is None:
        return
    nothing, colour = np.zeros(3), np.array([*rgb, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, kind.value, nothing, nothing, np.eye(3).ravel(), colour)
    mujoco.mjv_connector(geom, kind.value, width, start, end)
    geom.emission, geom.specular = 0.2, 0.0


def _next_geom(scene: mujoco.MjvScene) -> mujoco.MjvGeom | None:
    """Return the scene's next free geom; None where it is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    scene.ngeom += 1
    geom: mujoco.MjvGeom = scene.geoms[scene.ngeom - 1]
    return geom
