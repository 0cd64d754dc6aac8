"""A teacher: a policy that gives the actions that it would take in the student's situation (ADR-0033).

Arm memory (ADR-0034): the curve of the flight shows the ball's spin. A student without memory, which observes only the
ball now, cannot see it. But the student observes its own arm, and two of its joints are free before the stroke. With
``arm_memory`` the teacher holds these joints, until shortly before the stroke, at a function of the ball's first
measurements. So the student writes from the ball, holds from the joints, and learns by itself to read them.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.env.rally_env import RallyEnv
from common.env.robot import JOINTS
from common.physics.constants import GRID_STEP, TABLE_HALF_LENGTH
from common.policy.box import policy_folder
from common.policy.contract import PolicyError
from common.policy.folder import Policy, load_policy
from common.task.config import TaskConfig
from common.task.experience import TeacherConfig
from common.task.observation import OBSERVATION, ObservationConfig, offsets, policy_layout

Floats = npt.NDArray[np.float32]

_AT = offsets(OBSERVATION)
_TARGET = _AT["target"]
COMING: Final = _AT["continuous_state"].start  # tau_01: launched, and the bounce is not yet measured
_MIDDLE = np.array([0.5 * TABLE_HALF_LENGTH, 0.0], np.float32)


class MemoryJoint(NamedTuple):
    """A joint that holds a number of the observation: at home + gain (number - middle) [half-range]."""

    joint: int
    number: int  # of the observation
    middle: float
    gain: float


MEMORY: Final = (
    MemoryJoint(JOINTS.index("roll"), _AT["ball_vel"].start + 1, 0.0, 0.22),  # y [m/s]: sidespin bends it
    MemoryJoint(JOINTS.index("wrist"), _AT["ball_pos"].start + 2, 0.48, 0.8),  # z [m]: topspin makes it fall
)
"""Fast joints that a stroke needs last. The launches of the presets use between a third and all of their range."""

MEMORY_JOINTS: Final = [memory.joint for memory in MEMORY]

FIRST_MEASURED: Final = 0.05  # [s] time after the launch during which the memory is written
STROKE: Final = 0.24  # [s] time before the interception from which on the stroke needs the joints
_LARGEST: Final = 0.95  # [half-range] largest target of a joint that holds a number


class Teacher:
    """A policy that observes the rallies that another policy plays.

    Args:
        policy: The teacher.
        target_shrink: Share of the way to the middle of the opponent's court by which its targets are moved.
        arm_memory: Whether free joints are held as memory.
    """

    def __init__(self, policy: Policy, target_shrink: float = 0.0, arm_memory: bool = False) -> None:
        self._policy, self._target_shrink = policy, target_shrink
        self._has_arm_memory = arm_memory
        self._memory = np.zeros(len(MEMORY), np.float32)  # (B, joints) from the first rallies on
        self._at = offsets(policy_layout(self.observation))

    @property
    def observation(self) -> ObservationConfig:
        """What the teacher observes: the environment's extra observation."""
        return self._policy.contract.task.observation

    def advice(self, env: RallyEnv, student_obs: Floats) -> Floats:
        """Return the teacher's actions now (B, 7), within [-1, 1].

        Args:
            env: The same rallies in each call, one control step later each time.
            student_obs: What the student observes (B, D).
        """
        obs = env.observe_extra()
        obs[:, _TARGET] += self._target_shrink * (_MIDDLE - obs[:, _TARGET])
        advice = np.clip(self._policy.act(obs), -1.0, 1.0)
        if self._has_arm_memory:
            self._hold_memory(env, student_obs, obs[:, self._at["interception_in"].start], advice)
        return advice

    def _hold_memory(
        self, env: RallyEnv, student_obs: Floats, interception_in: Floats, advice: Floats
    ) -> None:
        """Write the targets of joints that are still free into ``advice``."""
        numbers = student_obs[:, [memory.number for memory in MEMORY]]
        is_new = env.rallies.clock * GRID_STEP < FIRST_MEASURED
        self._memory = np.where(is_new[:, None], numbers, self._memory)
        is_free = (interception_in > STROKE) & (student_obs[:, COMING] > 0.5)
        for k, memory in enumerate(MEMORY):
            held = env.home_action[memory.joint] + memory.gain * (self._memory[:, k] - memory.middle)
            advice[:, memory.joint] = np.where(
                is_free, held.clip(-_LARGEST, _LARGEST), advice[:, memory.joint]
            )


def teacher_of(task: TaskConfig, config: TeacherConfig) -> Teacher | None:
    """Return the teacher, or None without one. It expects the same spin as the task.

    Raises:
        PolicyError: The policy can't be read, or can't play the task itself.
    """
    if not config.policy:
        return None
    policy = load_policy(policy_folder(config.policy))
    theirs = policy.contract.task
    for name, found, wanted in (
        ("control_rate_hz", theirs.control_rate_hz, task.control_rate_hz),
        ("robot", theirs.robot, task.robot),
        ("observation.history", theirs.observation.history, task.observation.history),
    ):
        if found != wanted:
            raise PolicyError(f"teacher {config.policy}: {name} is {found}; allowed: the task's, {wanted}")
    if config.arm_memory and not theirs.observation.prediction:
        raise PolicyError(
            f"teacher {config.policy}: observation.prediction is False; allowed with teacher.arm_memory: True, since "
            "joints are free until the teacher predicts the interception"
        )
    return Teacher(policy, config.target_shrink, config.arm_memory)
