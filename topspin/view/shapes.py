"""The hall as plain shapes: what a page draws, from the model that films are drawn of (``render.hall``)."""

from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import mujoco
import numpy as np
import numpy.typing as npt

from topspin.render.hall import BALL, load_hall

Array = npt.NDArray[np.float64]
Form = Literal["box", "cylinder", "capsule"]

_FORMS: Final[dict[int, Form]] = {
    mujoco.mjtGeom.mjGEOM_BOX.value: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER.value: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE.value: "capsule",
}
_PLANE, _SPHERE = mujoco.mjtGeom.mjGEOM_PLANE.value, mujoco.mjtGeom.mjGEOM_SPHERE.value
FLOOR_HALF: Final = (9.0, 9.0, 0.01)  # [m] MuJoCo's floor has no end


@dataclass(frozen=True, slots=True)
class Shape:
    """One rigid part of a body, in the body's frame."""

    body: str
    form: Form
    half: tuple[float, float, float]  # [m] half sizes; of a cylinder or capsule: radius, half length, 0
    pos: tuple[float, float, float]  # [m]
    quat: tuple[float, float, float, float]  # (w, x, y, z)
    colour: tuple[float, float, float]
    opacity: float


def shapes_of(model: mujoco.MjModel) -> list[Shape]:
    """Return the visible shapes of a hall; the ball is not among them, because a page draws its own."""
    found = []
    for geom in range(model.ngeom):
        body, kind, size = (
            model.body(model.geom_bodyid[geom]).name,
            int(model.geom_type[geom]),
            model.geom_size[geom],
        )
        rgba = model.geom_rgba[geom]
        if rgba[3] == 0.0 or body == BALL:
            continue
        form, half = _FORMS.get(kind, "box"), tuple(float(part) for part in size)
        if kind == _PLANE:
            half = FLOOR_HALF
        pos = model.geom_pos[geom] - (np.array([0.0, 0.0, FLOOR_HALF[2]]) if kind == _PLANE else 0.0)
        red, green, blue, opacity = (float(part) for part in rgba)
        x, y, z = (float(part) for part in pos)
        a, b, c, d = (float(part) for part in model.geom_quat[geom])
        found.append(
            Shape(
                body, form, (half[0], half[1], half[2]), (x, y, z), (a, b, c, d), (red, green, blue), opacity
            )
        )
    return found


class Robot:
    """The robot's bodies for any joint positions.

    Args:
        name: The robot's name.
    """

    def __init__(self, name: str) -> None:
        self._model = load_hall(name)
        self._data = mujoco.MjData(self._model)
        self.shapes = shapes_of(self._model)
        self.bodies = tuple(dict.fromkeys(shape.body for shape in self.shapes if shape.body != "world"))
        self._ids = [self._model.body(body).id for body in self.bodies]

    def poses(self, joints: Array) -> tuple[Array, Array]:
        """Return positions (n, 3) [m] and quaternions (n, 4) of ``bodies`` for joint positions (7,) [m, rad]."""
        self._data.qpos[:7] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos[self._ids].copy(), self._data.xquat[self._ids].copy()


robot = cache(Robot)
"""The robot of a name; compiling its model takes about half a second, once."""
