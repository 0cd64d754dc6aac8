"""Corrections of an environment: of the actions before each hit, by the drives' limits, and of those after it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.physics.flight_model import Flight
from common.rally.hit_correction import BACK, DriveHistories, corrections
from common.rally.state import Rallies, RobotMotion

Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class HitCorrections:
    """Balls hit in one step, and how the last actions should have differed."""

    rows: Rows  # (n,) which environment
    corrections: Floats  # (n, BACK, 7) [half-range] by control step, the newest first
    steps: Rows  # (n,) how many control steps back each reaches: at most to the rally's beginning


NO_HIT_CORRECTIONS: Final = HitCorrections(
    np.zeros(0, np.int64), np.zeros((0, BACK, 7), np.float32), np.zeros(0, np.int64)
)


# [half-range] a correction after the hit is no longer: about as long as those before it, which it would outweigh
FARTHEST: Final = 0.02


def way_home(mean: Floats, home: Floats) -> Floats:
    """Return how mean actions (n, 7) after the hit should differ (n, 7): towards home (7,) [half-range].

    Nothing that the robot does after its hit moves this ball. But the next one finds it where it is, and rewards say
    so late and faintly (ADR-0064).
    """
    change = home - mean
    length = np.linalg.norm(change, axis=-1, keepdims=True)
    shorter: Floats = change * np.minimum(1.0, FARTHEST / np.maximum(length, FARTHEST))
    return shorter


class HitCorrector:
    """Records which drives were at their limits, and corrects hits (``common/rally/hit_correction.py``).

    Args:
        robot: The robots.
        flight: Model of the aerodynamics.
    """

    def __init__(self, robot: RobotBatch, flight: Flight) -> None:
        self._flight_model = int(flight)
        self._drives = robot.drives
        self._robot = robot
        self._limits = np.zeros((robot.count, BACK, robot.substeps, 7), np.int8)
        self._losses = np.zeros((robot.count, BACK, robot.substeps, 7), np.float32)
        self._newest = 0
        self._found = np.zeros((robot.count, BACK, 7))
        self._steps = np.zeros(robot.count, np.int64)

    def update(self, rallies: Rallies, motion: RobotMotion, corrects: bool) -> HitCorrections:
        """Record one control step of all robots, and return the corrections of its hits if ``corrects``."""
        self._newest = (self._newest + 1) % BACK
        self._robot.record_limits(motion, self._limits[:, self._newest], self._losses[:, self._newest])
        if not corrects:
            return NO_HIT_CORRECTIONS
        corrections(
            self._robot.chain,
            rallies.hit,
            rallies.parameters,
            self._flight_model,
            DriveHistories(self._limits, self._losses, self._newest, self._drives, motion.step),
            self._found,
            self._steps,
        )
        rows = np.flatnonzero(self._steps)
        return HitCorrections(rows, self._found[rows].astype(np.float32), self._steps[rows])
