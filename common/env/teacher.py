"""A policy that says what it would have done in another's place."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvConfig, RallyEnv
from common.policy.weights import Policy, PolicyError, load_policy
from common.rally.observation import ObservationConfig

Floats = npt.NDArray[np.float32]


class Teacher:
    """A policy that looks on while another plays.

    Args:
        policy: It, read from its folder.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    @property
    def sees(self) -> ObservationConfig:
        """What it must be shown: the environment's onlooker."""
        return self._policy.contract.observation_options

    def advice(self, env: RallyEnv) -> Floats:
        """Return what it would do now (B, 7), within [-1, 1]."""
        return np.clip(self._policy.act(env.look_on()), -1.0, 1.0)


def teacher_of(task: EnvConfig) -> Teacher | None:
    """Return a task's teacher, or None where it has none.

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
    return Teacher(policy)
