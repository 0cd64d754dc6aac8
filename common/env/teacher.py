"""A policy that says what it would have done in another's place."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvConfig, RallyEnv
from common.physics.constants import TABLE_HALF_LENGTH
from common.policy.weights import Policy, PolicyError, load_policy
from common.rally.observation import OBSERVATION, ObservationConfig, offsets

Floats = npt.NDArray[np.float32]

_TARGET = offsets(OBSERVATION)["target"]
_MIDDLE = np.array([0.5 * TABLE_HALF_LENGTH, 0.0], np.float32)


class Teacher:
    """A policy that looks on while another plays.

    Args:
        policy: It, read from its folder.
        towards_middle: Share of the way to the middle of the opponent's court by which targets are moved for it.
    """

    def __init__(self, policy: Policy, towards_middle: float = 0.0) -> None:
        self._policy, self._towards_middle = policy, towards_middle

    @property
    def sees(self) -> ObservationConfig:
        """What it must be shown: the environment's onlooker."""
        return self._policy.contract.observation_options

    def advice(self, env: RallyEnv) -> Floats:
        """Return what it would do now (B, 7), within [-1, 1]."""
        seen = env.look_on()
        seen[:, _TARGET] += self._towards_middle * (_MIDDLE - seen[:, _TARGET])
        return np.clip(self._policy.act(seen), -1.0, 1.0)


def teacher_of(task: EnvConfig) -> Teacher | None:
    """Return a task's teacher, or None where it has none. What spins it is told to expect is the task's.

    Raises:
        PolicyError: It can't be read, or couldn't play the task itself.
    """
    if not task.teacher.policy:
        return None
    policy = load_policy(Path(task.teacher.policy))
    contract, history = policy.contract, policy.contract.observation_options.history
    for name, theirs, ours in (
        ("control_rate_hz", contract.control_rate_hz, task.control_rate_hz),
        ("robot", contract.robot, task.robot),
        ("observation.history", history, task.observation.history),
    ):
        if theirs != ours:
            raise PolicyError(
                f"teacher {task.teacher.policy}: {name} is {theirs}; allowed is the task's, {ours}"
            )
    return Teacher(policy, task.teacher.towards_middle)
