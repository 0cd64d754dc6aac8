"""B MuJoCo robots stepped together: targets in, joint records out, one Python call a control step."""

import logging
import math
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from common.rally.play import Motion

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
RobotPreset = Literal["rails", "usst"]

MODEL_PATH = Path(__file__).with_name("robot.xml")
MUJOCO_STEP = 0.004  # [s] racket pose against 0.25 ms: tests/unit/env/test_robot.py states the error
MUJOCO_STEP_200_HZ = 0.0025  # [s] where 4 ms don't divide the control period: 200 Hz, 100 Hz
JOINTS = ("rail_x", "rail_y", "yaw", "pitch", "elbow", "wrist", "roll")
RACKET_BODY = "racket"
_UNDER_WAY = 1.0  # [s] MuJoCo's time as a control step begins: a simulation that was reset shows
MAX_ACTION_LATENCY = 0.020  # [s] how far back targets are kept: the latest of any noise profile

# Published limits of the group's robot: rails [m/s], yaw and pitch, the last three joints [rad/s]
USST_SPEED_LIMITS = (2.0, 2.0, 11.64, 11.64, 5.86, 5.86, 5.86)


def load_model(preset: RobotPreset = "rails", step: float = MUJOCO_STEP) -> mujoco.MjModel:
    """Return the compiled robot.

    Args:
        preset: ``rails`` (our robot) or ``usst`` (the same, slowed to the authors' published joint speeds:
            damping is the speed limit, since MuJoCo has none).
        step: MuJoCo's time step [s].
    """
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    model.opt.timestep = step
    limit_speeds(model, preset)
    return model


def limit_speeds(model: mujoco.MjModel, preset: RobotPreset) -> None:
    """Slow the robot's joints down to what a preset allows, in place."""
    if preset == "usst":
        for joint, limit in enumerate(USST_SPEED_LIMITS):
            model.dof_damping[joint] = model.actuator_forcerange[joint, 1] / limit


def inertia_at_home(model: mujoco.MjModel) -> Array:
    """Return the joints' mass matrix at the home pose (7, 7) [kg, kg m, kg m^2]."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return inertia[:7, :7]


def home_action(preset: RobotPreset = "rails") -> npt.NDArray[np.float32]:
    """Return the action (7,) that holds the home pose."""
    model = load_model(preset)
    limits = np.array(model.actuator_ctrlrange)
    middle = limits.mean(axis=1)
    action: npt.NDArray[np.float32] = ((model.key("home").qpos - middle) / (limits[:, 1] - middle)).astype(
        np.float32
    )
    return action


class RobotBatch:
    """B simulations of the robot on one thread.

    Args:
        count: B.
        preset: See ``load_model``.
        control_rate_hz: Control steps a second; its period must be a multiple of MuJoCo's step.
        step: MuJoCo's time step [s]; None: the default for this control rate.
        threads: MuJoCo threads; 1 keeps an actor on one core.
        model: A model whose first seven joints and actuators are the robot's, in place of the robot alone.
    """

    def __init__(
        self,
        count: int,
        preset: RobotPreset = "rails",
        control_rate_hz: float = 50.0,
        step: float | None = None,
        threads: int = 1,
        model: mujoco.MjModel | None = None,
    ) -> None:
        period = 1.0 / control_rate_hz
        if step is None:
            step = (
                MUJOCO_STEP
                if abs(period / MUJOCO_STEP - round(period / MUJOCO_STEP)) < 1e-9
                else MUJOCO_STEP_200_HZ
            )
        self.substeps = round(period / step)
        if abs(self.substeps * step - period) > 1e-9:
            raise ValueError(f"control period {period} s is not a multiple of the MuJoCo step {step} s")
        self.step_s = step
        self.count = count
        self.model = load_model(preset, step) if model is None else model
        self.batch = Batch(self.model, count, threads)
        self.joint_pos: Array = self.batch.bind("qpos")[:, :7]
        self.joint_vel: Array = self.batch.bind("qvel")[:, :7]
        self._ctrl: Array = self.batch.bind("ctrl")
        self._wrench: Array = self.batch.bind("xfrc_applied")
        self._racket = self.model.body(RACKET_BODY).id
        limits = np.array(self.model.actuator_ctrlrange)
        self.middle: Array = limits.mean(axis=1)
        self.half_range: Array = limits[:, 1] - self.middle
        self.torque_limit: Array = np.array(self.model.actuator_forcerange[:, 1])
        self.home: Array = np.array(self.model.key("home").qpos[:7])
        self.home_action: Array = (self.home - self.middle) / self.half_range
        # Gains and damping differ from rally to rally.
        self._kp: Array = np.array(self.model.actuator_gainprm[:, 0])
        self._kv: Array = -np.array(self.model.actuator_biasprm[:, 2])
        self._damping_nominal: Array = np.array(self.model.dof_damping[:7])
        self._gain: Array = self.batch.expand("actuator_gainprm")
        self._bias: Array = self.batch.expand("actuator_biasprm")
        self._damping: Array = self.batch.expand("dof_damping")
        self._time: Array = self.batch.bind("time")
        self.faulty: Rows = np.zeros(0, np.int64)
        # Targets of the control steps before this one, newest first: a latency may exceed a control period.
        self._held: Array = np.tile(self.home, (math.ceil(MAX_ACTION_LATENCY / period - 1e-9), count, 1))
        self._late_substeps = np.zeros(count, np.int64)
        self._substep_index = np.arange(self.substeps)
        self._control = np.empty((count, self.substeps, 7))
        self._start = np.empty((count, 7))
        self._records: dict[str, Array] = {}
        self.go_home(np.arange(count), np.zeros((count, 7)))

    def go_home(self, rows: Rows, offset: Array) -> None:
        """Put robots ``rows`` at rest at home plus ``offset`` (n, 7) [m, rad]."""
        self.batch.reset(ids=rows, keyframe=0, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self.joint_pos[rows] = self.home + offset
        self._held[:, rows] = self.home

    def set_gains(self, rows: Rows, factors: Array, action_latency: Array) -> None:
        """Give robots ``rows`` their drives: factors of kp, kv, damping (n, 3, 7) and latency [s] (n,)."""
        kp = self._kp * factors[:, 0]
        self._gain[rows, :, 0] = kp
        self._bias[rows, :, 1] = -kp
        self._bias[rows, :, 2] = -self._kv * factors[:, 1]
        self._damping[rows, :7] = self._damping_nominal * factors[:, 2]
        self._late_substeps[rows] = np.rint(action_latency / self.step_s).astype(np.int64)

    @property
    def drives(self) -> Array:
        """``common.rally.hindsight``'s table of the drives (5, 7): inertia at home, k_p, k_v, damping, half-range."""
        inertia = np.diag(inertia_at_home(self.model))
        return np.stack([inertia, self._kp, self._kv, self._damping_nominal, self.half_range])

    def push_racket(self, impulse: Array) -> None:
        """Apply (B, 6) impulses [N s, N m s] about the racket's centre, spread over the next control step."""
        self._wrench[:, self._racket] = impulse * (1.0 / (self.substeps * self.step_s))

    def step(self, actions: Array) -> Motion:
        """Return the motion of one control step under ``actions`` (B, 7) in [-1, 1].

        Robots that MuJoCo gave up on stand at home afterwards; ``faulty`` names them until the next step.
        """
        target = self.middle + self.half_range * actions
        self._start[:] = self.joint_pos
        self._time[:] = _UNDER_WAY
        np.copyto(self._control, target[:, None, :])
        for age, held in enumerate(self._held):
            late = self._substep_index < self._late_substeps[:, None] - age * self.substeps
            np.copyto(self._control, held[:, None, :], where=late[:, :, None])
        self._held[1:] = self._held[:-1]
        self._held[0] = target
        r = self._records = self._advance(self._control)
        # MuJoCo resets a simulation that meets NaN or huge numbers: its time starts at 0 again.
        behind = _UNDER_WAY + self.substeps * self.step_s - self._time
        self.faulty = np.flatnonzero(~(np.abs(behind) < 0.5 * self.step_s))
        if self.faulty.size:
            self._recover(self.faulty)
        return Motion(self._start, r["qpos"], r["actuator_force"], r["sensordata"], self.step_s)

    def _advance(self, control: Array) -> dict[str, Array]:
        """Return records (B, substeps, ...) of a control step under joint targets (B, substeps, 7)."""
        records: dict[str, Array] = self.batch.rollout(
            self.substeps,
            control=control,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=("qpos", "actuator_force", "sensordata"),
            out=self._records,
        )
        return records

    def _recover(self, rows: Rows) -> None:
        """Stand robots ``rows`` at home, at rest, as if they had been there for the whole control step."""
        log.warning("robots sent home after a simulation fault count=%d first=%d", rows.size, rows[0])
        self.go_home(rows, np.zeros((rows.size, 7)))
        self._start[rows] = self.home
        self._records["qpos"][rows, :, :7] = self.home
        self._records["actuator_force"][rows] = 0.0
        self._records["sensordata"][rows] = 0.0
