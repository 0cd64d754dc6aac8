"""The observer for a robot: what a policy observes, from what the robot measures."""

from common.rally.observer import Observer as RallyObserver
from common.robot.chain_of import chain_of
from common.task.config import TaskConfig
from common.task.randomization import PROFILES


class Observer(RallyObserver):
    """Makes one robot's observations.

    Args:
        task: The policy's: ``policy.contract.task``.
        position_noise: Standard deviation of a sample's position per axis [m]; default: as in training.
        velocity_noise: Standard deviation of its velocity per axis [m/s].

    Raises:
        ValueError: The policy observes the ball's true spin, which no robot can measure.
        RobotError: There is no such robot here.
    """

    def __init__(
        self,
        task: TaskConfig,
        position_noise: float = PROFILES["standard"].position_noise,
        velocity_noise: float = PROFILES["standard"].velocity_noise,
    ) -> None:
        super().__init__(task.observation, chain_of(task.robot), position_noise, velocity_noise)
