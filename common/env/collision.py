"""The seam between the environment and whose collisions the ball obeys: ours, or the simulator's own."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.rally import play
from common.rally.noise import NoiseProfile

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


class Collision(Protocol):
    """Robots, and how balls move among them. Rules, reward and what is seen are the same for all."""

    robot: RobotBatch
    motion: play.Motion  # of the robots in the last step

    def launch(self, rallies: play.Rallies, rows: Rows) -> None:
        """Take over the balls of ``rows``, which were launched just now."""

    def step(
        self, rallies: play.Rallies, actions: Array, rules: play.Rules, noise: NoiseProfile, step: play.Step
    ) -> None:
        """Play one control step under ``actions`` (B, 7); ``rallies`` and ``step`` are written in place."""


class TailoredCollision:
    """The ball flies outside MuJoCo, exact in time, and bounces by measured laws (``common/physics``)."""

    def __init__(self, robot: RobotBatch) -> None:
        self.robot = robot

    def launch(self, rallies: play.Rallies, rows: Rows) -> None:
        """Do nothing: the rallies' rows are the balls."""

    def step(
        self, rallies: play.Rallies, actions: Array, rules: play.Rules, noise: NoiseProfile, step: play.Step
    ) -> None:
        """Play one control step; the ball's impulse on the racket acts in the next one."""
        self.motion = self.robot.step(actions)
        play.play_step(rallies, self.motion, actions, rules, noise, step)
        self.robot.push_racket(step.impulse)
