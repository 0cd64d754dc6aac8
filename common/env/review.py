"""Reviewing hits: the robots' last steps are remembered, so that a hit can say what the actions should have been."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.rally.hindsight import BACK, corrections
from common.rally.play import Motion, Rallies

Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]

AT_LIMIT = 1.0 - 1e-9  # [-] share of a drive's largest force from which on it is at its limit


@dataclass(frozen=True, slots=True)
class Lessons:
    """Balls hit in one step, and by what the last actions differed from what they should have been."""

    rows: Rows  # (n,) which environment
    corrections: Floats  # (n, BACK, 7) [half-range] by control step, the newest first
    steps: Rows  # (n,) how many steps back they reach: a rally's beginning cuts them


NO_LESSONS = Lessons(np.zeros(0, np.int64), np.zeros((0, BACK, 7), np.float32), np.zeros(0, np.int64))


class Review:
    """Remembers which drives were at their limits, and corrects hits (``common/rally/hindsight.py``).

    Args:
        robot: The robots.
        flight_model: ``flight.SIMPLE`` or ``flight.FULL``.
    """

    def __init__(self, robot: RobotBatch, flight_model: int) -> None:
        self._flight_model = flight_model
        self._drives = robot.drives
        self._largest = robot.torque_limit * AT_LIMIT
        self._limited = np.zeros((robot.count, BACK, robot.substeps, 7), np.bool_)
        self._newest = 0
        self._found = np.zeros((robot.count, BACK, 7))
        self._steps = np.zeros(robot.count, np.int64)

    def look(self, rallies: Rallies, motion: Motion, corrects: bool) -> Lessons:
        """Remember one control step of all robots; return what its hits say, if ``corrects``."""
        self._newest = (self._newest + 1) % BACK
        self._limited[:, self._newest] = np.abs(motion.torque) >= self._largest
        if not corrects:
            return NO_LESSONS
        corrections(
            rallies.hit,
            rallies.condition,
            self._flight_model,
            self._limited,
            self._newest,
            self._drives,
            motion.step,
            self._found,
            self._steps,
        )
        rows = np.flatnonzero(self._steps)
        return Lessons(rows, self._found[rows].astype(np.float32), self._steps[rows])
