"""B MuJoCo robots stepped together: joint targets in, joint motion out, one Python call a control step."""

import logging
import math

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from common.physics.chain import JOINTS, Chain
from common.rally.state import RobotMotion
from common.robot.chain_of import chain_of
from common.robot.description import RobotDescription, describe
from common.robot.model import LinkSensors, load_model

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

# [s] tests/unit/env/test_robot.py states the racket's error against steps of 0.25 ms (ADR-0005)
MUJOCO_STEP = 0.004
MUJOCO_STEP_200_HZ = 0.0025  # [s] where 4 ms don't divide the control period: at 100 Hz and 200 Hz
_START_TIME = 1.0  # [s] MuJoCo's time at the start of each control step; a reset simulation starts at 0 again
MAX_ACTION_LATENCY = 0.020  # [s] targets are kept so long: the longest action latency of all profiles
_KP, _KV = 4, 6  # columns of a dcmotor's gain parameters


def home_action(name: str = "rails") -> npt.NDArray[np.float32]:
    """Return the action (7,) that holds the home pose of a robot."""
    joints = describe(name).joint
    low, high = np.array([joint.range for joint in joints]).T
    home = np.array([joint.home for joint in joints])
    action: npt.NDArray[np.float32] = ((home - 0.5 * (low + high)) / (0.5 * (high - low))).astype(np.float32)
    return action


class RobotBatch:
    """B simulations of the robot.

    Args:
        count: B.
        name: Of the robot (``common/robot``).
        control_rate_hz: Control steps a second. The control period must be a multiple of MuJoCo's step.
        step: MuJoCo's time step [s]; None: the default for this control rate.
        threads: MuJoCo threads. With 1 an actor uses one core.
        model: A model whose first seven joints and actuators are the robot's; None: the robot alone.
    """

    def __init__(
        self,
        count: int,
        name: str = "rails",
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
        self.model = load_model(name, step) if model is None else model
        self.name = name
        self.description: RobotDescription = describe(name)
        self.chain: Chain = chain_of(name)
        self.batch = Batch(self.model, count, threads)
        self.joint_pos: Array = self.batch.bind("qpos")[:, :7]
        self.joint_vel: Array = self.batch.bind("qvel")[:, :7]
        self._ctrl: Array = self.batch.bind("ctrl")
        self._wrench: Array = self.batch.bind("xfrc_applied")
        self._racket = self.model.geom_bodyid[self.model.geom(self.description.racket).id]
        joints = self.description.joint
        limits = np.array([joint.range for joint in joints])
        self.middle: Array = limits.mean(axis=1)
        self.half_range: Array = limits[:, 1] - self.middle
        self.torque_limit: Array = np.array([joint.force for joint in joints])
        self.speed_limit: Array = np.array([joint.speed for joint in joints])
        self.home: Array = np.array([joint.home for joint in joints])
        self.home_action: Array = (self.home - self.middle) / self.half_range
        # Gains and damping differ between rallies
        self._kp: Array = np.array([joint.kp for joint in joints])
        self._kv: Array = np.array([joint.kv for joint in joints])
        self._damping_nominal: Array = np.array(self.model.dof_damping[:JOINTS])
        self._gain: Array = self.batch.expand("actuator_gainprm")
        self._damping: Array = self.batch.expand("dof_damping")
        self._time: Array = self.batch.bind("time")
        self.faulty: Rows = np.zeros(0, np.int64)
        # Targets of earlier control steps, newest first: a latency may be longer than a control period
        self._earlier_targets: Array = np.tile(
            self.home, (math.ceil(MAX_ACTION_LATENCY / period - 1e-9), count, 1)
        )
        self._late_substeps = np.zeros(count, np.int64)
        self._substep_index = np.arange(self.substeps)
        self._control = np.empty((count, self.substeps, 7))
        self._start = np.empty((count, 7))
        self._records: dict[str, Array] = {}
        self.go_home(np.arange(count), np.zeros((count, 7)))

    def go_home(self, rows: Rows, offset: Array) -> None:
        """Put robots ``rows`` at home plus ``offset`` (n, 7) [m, rad], at rest."""
        self.batch.reset(ids=rows, keyframe=0, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self.joint_pos[rows] = self.home + offset
        self._earlier_targets[:, rows] = self.home

    def set_gains(self, rows: Rows, factors: Array, action_latency: Array) -> None:
        """Set the drives of robots ``rows``: factors of kp, kv and damping (n, 3, 7), action latency [s] (n,)."""
        self._gain[rows, :, _KP] = self._kp * factors[:, 0]
        self._gain[rows, :, _KV] = self._kv * factors[:, 1]
        self._damping[rows, :7] = self._damping_nominal * factors[:, 2]
        self._late_substeps[rows] = np.rint(action_latency / self.step_s).astype(np.int64)

    def push_racket(self, impulse: Array) -> None:
        """Apply impulses (B, 6) [N s, N m s] at the racket's centre, spread over the next control step."""
        self._wrench[:, self._racket] = impulse * (1.0 / (self.substeps * self.step_s))

    def step(self, actions: Array) -> RobotMotion:
        """Return the motion of one control step under ``actions`` (B, 7) in [-1, 1].

        If MuJoCo reset a simulation, its robot is at home afterwards. ``faulty`` has these rows until the next step.
        """
        target = self.middle + self.half_range * actions
        self._start[:] = self.joint_pos
        self._time[:] = _START_TIME
        np.copyto(self._control, target[:, None, :])
        for age, earlier in enumerate(self._earlier_targets):
            late = self._substep_index < self._late_substeps[:, None] - age * self.substeps
            np.copyto(self._control, earlier[:, None, :], where=late[:, :, None])
        self._earlier_targets[1:] = self._earlier_targets[:-1]
        self._earlier_targets[0] = target
        r = self._records = self._advance(self._control)
        # MuJoCo resets a simulation with NaN or huge numbers: its time starts at 0 again
        missing_time = _START_TIME + self.substeps * self.step_s - self._time
        self.faulty = np.flatnonzero(~(np.abs(missing_time) < 0.5 * self.step_s))
        if self.faulty.size:
            self._recover(self.faulty)
        return RobotMotion(self._start, r["qpos"], r["actuator_force"], self.sensors.touch, self.step_s)

    @property
    def sensors(self) -> LinkSensors:
        """What the links' sensors measured in the last control step (B, n, ...)."""
        return LinkSensors.of(self._records["sensordata"], len(self.description.links))

    def _advance(self, control: Array) -> dict[str, Array]:
        """Return MuJoCo's records (B, substeps, ...) of a control step under joint targets (B, substeps, 7)."""
        records: dict[str, Array] = self.batch.rollout(
            self.substeps,
            control=control,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=("qpos", "actuator_force", "sensordata"),
            out=self._records,
        )
        return records

    def _recover(self, rows: Rows) -> None:
        """Put robots ``rows`` at home, at rest, as if they had been there for the whole control step."""
        log.warning("robots sent home after a simulation fault count=%d first=%d", rows.size, rows[0])
        self.go_home(rows, np.zeros((rows.size, 7)))
        self._start[rows] = self.home
        self._records["qpos"][rows, :, :7] = self.home
        self._records["actuator_force"][rows] = 0.0
        self._records["sensordata"][rows] = 0.0
