"""A teacher: a policy that gives the actions that it would take in the student's situation (ADR-0033)."""

import numpy as np
import numpy.typing as npt

from common.env.rally_env import RallyEnv
from common.physics.constants import TABLE_HALF_LENGTH
from common.policy.box import policy_folder
from common.policy.contract import PolicyError
from common.policy.folder import Policy, load_policy
from common.task.config import TaskConfig
from common.task.experience import TeacherConfig
from common.task.observation import OBSERVATION, ObservationConfig, offsets

Floats = npt.NDArray[np.float32]

_TARGET = offsets(OBSERVATION)["target"]
_MIDDLE = np.array([0.5 * TABLE_HALF_LENGTH, 0.0], np.float32)


class Teacher:
    """A policy that observes the rallies that another policy plays.

    Args:
        policy: The teacher.
        target_shrink: Share of the way to the middle of the opponent's court by which its targets are moved.
    """

    def __init__(self, policy: Policy, target_shrink: float = 0.0) -> None:
        self._policy, self._target_shrink = policy, target_shrink

    @property
    def observation(self) -> ObservationConfig:
        """What the teacher observes: the environment's extra observation."""
        return self._policy.contract.task.observation

    def advice(self, env: RallyEnv) -> Floats:
        """Return the teacher's actions now (B, 7), within [-1, 1].

        Args:
            env: The same rallies in each call, one control step later each time.
        """
        obs = env.observe_extra()
        obs[:, _TARGET] += self._target_shrink * (_MIDDLE - obs[:, _TARGET])
        return np.clip(self._policy.act(obs), -1.0, 1.0)


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
    return Teacher(policy, config.target_shrink)
