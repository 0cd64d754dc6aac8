"""The measures: rates over valid rallies with Wilson intervals, and the landing error.

catch = legal racket contact / rallies; over = crosses the net after it / rallies; return = legal landing / rallies;
return after catch = return / catch; target error = planar distance of legal landings to the target.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from common.evaluation.robot_measures import RobotRecord
from common.task.states import Outcome

Array = npt.NDArray[np.float64]

Z_95 = 1.959963984540054  # two-sided 95 %
WITHIN_M = (0.2, 0.3)  # [m] limits: the share of landings within each is a measure


@dataclass(frozen=True, slots=True)
class MatchResult:
    """Rallies that were played to their end, one row each. All are validated."""

    seeds: npt.NDArray[np.uint64]  # (n,)
    outcomes: npt.NDArray[np.uint8]  # (n,)
    landing_errors: npt.NDArray[np.float32]  # (n,) [m], nan where nothing landed
    caught: npt.NDArray[np.bool_]  # (n,)
    over: npt.NDArray[np.bool_]  # (n,)
    returns: npt.NDArray[np.float32]  # (n,) reward
    rounds: npt.NDArray[np.int32]  # (n,) number of the rally in its episode, from 1
    launches: Array  # (n, 12) position [m], velocity [m/s], spin [rad/s], drag and lift factor, kind
    landings: npt.NDArray[np.float32]  # (n, 2) [m] on the opponent's court, nan where nothing landed
    targets: Array  # (n, 2) [m]
    bounces: Array  # (n, 2) [m] on the robot's court
    arrivals: (
        Array  # (n, 3) [m] at the end of the table, unplayed; nan where the ball bounces twice before it
    )
    robot: RobotRecord | None = None  # what the robot did, in the same order

    def of(self, chosen: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> "MatchResult":
        """Return the rallies that ``chosen`` marks (n,) or numbers."""
        rows = {name: getattr(self, name)[chosen] for name in _COLUMNS}
        return MatchResult(**rows, robot=None if self.robot is None else self.robot.of(chosen))

    @staticmethod
    def together(parts: Sequence["MatchResult"]) -> "MatchResult":
        """Return the rallies of several matches as one."""
        rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        robots = [part.robot for part in parts if part.robot is not None]
        return MatchResult(**rows, robot=RobotRecord.together(robots) if robots else None)


_COLUMNS: Final = [field.name for field in fields(MatchResult) if field.name != "robot"]


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, Z_95 * Z_95
    middle = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials * trials)) / (1 + z2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def measures(played: MatchResult) -> dict[str, Any]:
    """Return the measures by name, ready for JSON; a rate without trials is None."""
    rallies = len(played.outcomes)
    returned = played.outcomes == Outcome.RETURNED
    caught, over, landed = int(played.caught.sum()), int(played.over.sum()), int(returned.sum())
    errors = played.landing_errors[returned].astype(np.float64)
    result: dict[str, Any] = {"rallies": rallies}
    for name, successes, trials in (
        ("catch_rate", caught, rallies),
        ("over_rate", over, rallies),
        ("return_rate", landed, rallies),
        ("return_after_catch", landed, caught),
    ):
        result[name] = round(successes / trials, 4) if trials else None
        result[f"{name}_ci"] = [round(bound, 4) for bound in wilson(successes, trials)]
    result["target_error_mean"] = round(float(errors.mean()), 4) if landed else None
    half = Z_95 * float(errors.std(ddof=1)) / math.sqrt(landed) if landed > 1 else None
    result["target_error_mean_ci"] = (
        [round(float(errors.mean()) - half, 4), round(float(errors.mean()) + half, 4)]
        if half is not None
        else None
    )
    result["target_error_median"] = round(float(np.median(errors)), 4) if landed else None
    for limit in WITHIN_M:
        result[f"within_{limit:.1f}_m"] = round(float((errors < limit).mean()), 4) if landed else None
    counts = np.bincount(played.outcomes, minlength=len(Outcome))
    result["outcomes"] = {
        outcome.name.lower(): int(counts[outcome]) for outcome in Outcome if counts[outcome]
    }
    return result
