"""The observer for a robot: what a policy observes, from what the robot measures."""

import time

from common.physics.chain import JOINTS
from common.rally.observer import BallSample
from common.rally.observer import Observer as RallyObserver
from common.robot.chain_of import chain_of
from common.task.config import TaskConfig
from common.task.randomization import profile_of


class Observer(RallyObserver):
    """Makes one robot's observations.

    Args:
        task: The policy's: ``policy.contract.task``.
        position_noise: Standard deviation of a sample's position per axis [m]; None: as in the task's randomization.
        velocity_noise: Standard deviation of its velocity per axis [m/s]; None: the same.

    Raises:
        ValueError: The policy observes the ball's true spin, which no robot can measure.
        RobotError: There is no such robot here.
    """

    def __init__(
        self,
        task: TaskConfig,
        position_noise: float | None = None,
        velocity_noise: float | None = None,
    ) -> None:
        profile = profile_of(task.randomization, task.rubber)
        super().__init__(
            task.observation,
            chain_of(task.robot),
            profile.position_noise if position_noise is None else position_noise,
            profile.velocity_noise if velocity_noise is None else velocity_noise,
        )
        self._task = task

    def warm_up(self) -> float:
        """Compile what ``observe`` runs, or load it from the disk; return the time it took [s].

        Otherwise the first ``observe`` of a process waits for it. The made-up ball is another observer's, so nothing
        of it stays here.
        """
        started = time.perf_counter()
        other = Observer(self._task)
        other.begin((0.9, 0.0))
        zeros = [0.0] * JOINTS
        other.observe(0.0, zeros, zeros, BallSample((0.5, 0.0, 0.3), (-5.0, 0.0, 0.0), 0, 0.0))
        other.observe(0.2, zeros, zeros, BallSample((-0.5, 0.0, 0.1), (-5.0, 0.0, 2.0), 1, 0.2))
        return time.perf_counter() - started
