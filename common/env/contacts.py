"""Contacts of the ball: one interface for ours and for MuJoCo's (``mujoco_contacts``)."""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.rally.state import Rallies, RobotMotion, Rules, Step
from common.rally.step import play_step
from common.task.randomization import RandomizationProfile

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


class Contacts(Protocol):
    """Robots and balls: how balls move and touch. Rules, reward and perception are the same for all contacts."""

    robot: RobotBatch
    motion: RobotMotion  # of the robots in the last step

    def launch(self, rallies: Rallies, rows: Rows) -> None:
        """Take over the balls of ``rows``, which were just launched."""

    def step(
        self, rallies: Rallies, actions: Array, rules: Rules, profile: RandomizationProfile, step: Step
    ) -> None:
        """Play one control step under ``actions`` (B, 7). ``rallies`` and ``step`` are written in place."""


class TailoredContacts:
    """The ball flies outside MuJoCo, exact in time, and bounces by measured laws (``common/physics``)."""

    def __init__(self, robot: RobotBatch) -> None:
        self.robot = robot

    def launch(self, rallies: Rallies, rows: Rows) -> None:
        """Do nothing: the rallies' rows are the balls."""

    def step(
        self, rallies: Rallies, actions: Array, rules: Rules, profile: RandomizationProfile, step: Step
    ) -> None:
        """Play one control step. The ball's impulse on the racket acts in the next one."""
        self.motion = self.robot.step(actions)
        play_step(rallies, self.motion, actions, rules, profile, step)
        self.robot.push_racket(step.impulse)
