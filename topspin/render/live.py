"""The environment while it is played: its newest picture for Gymnasium, off screen or in a window."""

import os
import sys
import time
from typing import Final

import mujoco
import numpy as np
import numpy.typing as npt

from common.env.rally_env import RallyEnv
from common.evaluation.rally_recorder import turned
from common.physics.constants import GRID_STEP
from common.rally.state import RING, SAMPLE
from common.task.randomization import RallyParameter
from topspin.render.gl import Image, RenderError
from topspin.render.hall import BALL, load_hall
from topspin.render.replay import BallPath, Moment
from topspin.render.scene import CAMERAS, FIELD_OF_VIEW_DEG, Painter, decorate

Array = npt.NDArray[np.float64]

SIZE: Final = (960, 540)  # [pixels] of a picture
_NO_TURN: Final = np.array([1.0, 0.0, 0.0, 0.0])


class LiveRally:
    """The rally in play in the first environment, as a drawing needs it; told of each control step."""

    def __init__(self) -> None:
        self._seed, self._clock = -1, -1
        self._samples = np.empty((0, SAMPLE))  # since the launch, one a grid step
        self._turn = _NO_TURN

    def moment(self, env: RallyEnv) -> Moment:
        """Return what is drawn now."""
        rallies = env.rallies
        seed, clock, head = int(rallies.seed[0]), int(rallies.clock[0]), int(rallies.head[0])
        if seed != self._seed or clock < self._clock:
            self._seed, self._clock = seed, clock - 1
            self._samples, self._turn = np.empty((0, SAMPLE)), _NO_TURN
        new = (head - np.arange(min(clock - self._clock, RING))[::-1]) % RING
        self._samples = np.concatenate((self._samples, rallies.true_sample_ring[0, new]))
        pos, spin = rallies.ball[0, :3].copy(), rallies.ball[0, 6:9].copy()
        if len(self._samples) > 1:
            step = turned(np.stack((spin, spin)), GRID_STEP * (clock - self._clock))[1]
            self._turn = _product(step, self._turn)
        self._clock = clock
        times: Array = GRID_STEP * np.arange(len(self._samples), dtype=np.float64)
        states = self._samples[:, 6].astype(np.int64)
        return Moment(
            joints=env.robot.joint_pos[0].copy(),
            ball_pos=pos,
            ball_turn=self._turn,
            ball_spin=spin,
            target=rallies.parameters[0, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]],
            trail=BallPath(times, self._samples[:, :3], states),
            landing=rallies.landing[0].copy(),
        )


class LiveDrawing:
    """What Gymnasium's ``render`` shows of an environment.

    Args:
        mode: ``rgb_array`` or ``human``.
        robot: The robot's name.
        period: Time of a control step [s].

    Raises:
        RenderError: This machine can't draw in this mode; the text says what is missing.
    """

    def __init__(self, mode: str, robot: str, period: float) -> None:
        self._window = Window(robot, period) if mode == "human" else None
        self._painter = Painter(*SIZE, robot) if mode == "rgb_array" else None
        self._rally = LiveRally()
        self._moment: Moment | None = None

    def show(self, env: RallyEnv) -> None:
        """Keep the rally's newest moment, and show it in the window."""
        self._moment = self._rally.moment(env)
        if self._window is not None:
            self._window.show(self._moment)

    def picture(self) -> Image | None:
        """Return a picture (height, width, 3) of the newest moment; None where a window shows it, and before any."""
        if self._painter is None or self._moment is None:
            return None
        return self._painter.paint(self._moment, CAMERAS["side"])

    def close(self) -> None:
        """Close the window, and free the graphics memory."""
        for opened in (self._window, self._painter):
            if opened is not None:
                opened.close()
        self._window = self._painter = None


def _product(a: Array, b: Array) -> Array:
    """Return the quaternion of turn ``b`` and then ``a``."""
    product = np.empty(4)
    mujoco.mju_mulQuat(product, a, b)
    return product


class Window:
    """Draws moments in MuJoCo's native window, in real time: ``render_mode="human"``.

    Args:
        robot: The robot's name.
        period: Time between two moments [s].

    Raises:
        RenderError: There is no display.
    """

    def __init__(self, robot: str, period: float) -> None:
        has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if sys.platform.startswith("linux") and not has_display:
            raise RenderError(
                "render_mode 'human' needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
                "allowed here: 'rgb_array'"
            )
        from mujoco import viewer  # noqa: PLC0415  # it opens the window library

        self._model = load_hall(robot)
        self._data = mujoco.MjData(self._model)
        self._ball = self._model.body(BALL).mocapid[0]
        self._period, self._due = period, time.monotonic()
        self._handle = viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        camera = CAMERAS["side"]
        with self._handle.lock():
            self._model.vis.global_.fovy = FIELD_OF_VIEW_DEG
            self._handle.cam.lookat[:] = camera.look_at
            self._handle.cam.distance, self._handle.cam.azimuth = camera.distance, camera.azimuth_deg
            self._handle.cam.elevation = camera.elevation_deg
            self._handle.opt.sitegroup[:] = 0

    def show(self, moment: Moment) -> None:
        """Show a moment when it is due; a window that a person has closed stays closed."""
        if not self._handle.is_running():
            return
        with self._handle.lock():
            self._data.qpos[:7] = moment.joints
            self._data.mocap_pos[self._ball], self._data.mocap_quat[self._ball] = (
                moment.ball_pos,
                moment.ball_turn,
            )
            mujoco.mj_forward(self._model, self._data)
            if self._handle.user_scn is not None:
                self._handle.user_scn.ngeom = 0
                decorate(self._handle.user_scn, moment)
        self._handle.sync()
        time.sleep(max(self._due - time.monotonic(), 0.0))
        self._due = max(self._due, time.monotonic() - self._period) + self._period

    def close(self) -> None:
        """Close the window."""
        self._handle.close()
