"""The measures by kind of ball: which balls a policy catches and returns, and how well it aims them.

The bins are fixed, so that evaluations can be compared. Empty bins are left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from common.evaluation.measures import MatchResult, measures
from common.physics.constants import TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
from common.task.launch import KIND
from common.task.launch_presets import Kind
from common.task.states import Outcome

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

LITTLE_SPIN: Final = 20.0  # [rad/s] a slower spin has no kind: the surface moves at 0.4 m/s
SHOWN: Final = (
    "rallies",
    "catch_rate",
    "catch_rate_ci",
    "return_rate",
    "return_rate_ci",
    "return_after_catch",
    "return_after_catch_ci",
    "target_error_mean",
    "target_error_mean_ci",
)
"""The measures of each bin: a part of those that ``measures`` returns."""

_INF: Final = float("inf")


@dataclass(frozen=True, slots=True)
class Breakdown:
    """One way to divide balls into bins.

    Attributes:
        title: The quantity and its unit, for people.
        bins: Names in order.
        bin_of: Returns each rally's index into ``bins`` (n,); -1: in no bin.
    """

    title: str
    bins: tuple[str, ...]
    bin_of: Callable[[MatchResult], Integers]


def speeds(played: MatchResult) -> Array:
    """Return each ball's speed at launch (n,) [m/s]."""
    speed: Array = np.linalg.norm(played.launches[:, 3:6], axis=1)
    return speed


def spins(played: MatchResult) -> Array:
    """Return how fast each ball spins (n,) [rad/s]."""
    spin: Array = np.linalg.norm(played.launches[:, 6:9], axis=1)
    return spin


SPIN_KINDS: Final = ("topspin", "backspin", "sidespin", "corkscrew", f"under {LITTLE_SPIN:g} rad/s")


def spin_kinds(played: MatchResult) -> Integers:
    """Return which of SPIN_KINDS each ball's spin is, by its largest part (n,).

    Topspin and backspin turn about the horizontal across the flight, sidespin about the vertical, corkscrew about
    the flight's own direction.
    """
    velocity, spin = played.launches[:, 3:6], played.launches[:, 6:9]
    direction = velocity[:, :2] / np.linalg.norm(velocity[:, :2], axis=1, keepdims=True)
    # z x direction: the top of a ball that turns about it moves forward
    topspin = spin[:, 1] * direction[:, 0] - spin[:, 0] * direction[:, 1]
    corkscrew = (spin[:, :2] * direction).sum(axis=1)
    parts = np.stack(
        (np.maximum(topspin, 0), np.maximum(-topspin, 0), abs(spin[:, 2]), abs(corkscrew)), axis=1
    )
    return np.where(spins(played) < LITTLE_SPIN, len(SPIN_KINDS) - 1, parts.argmax(axis=1))


def _interval(low: float, high: float) -> str:
    if low == -_INF:
        return f"under {high:g}"
    return f"over {low:g}" if high == _INF else f"{low:g} to {high:g}"


def _by_edges(
    title: str, edges: Sequence[float], value: Callable[[MatchResult], Array], without: str = ""
) -> Breakdown:
    """Return a breakdown by [low, high) between edges; ``without`` names the bin of rallies whose value is nan."""
    names = tuple(_interval(low, high) for low, high in pairwise(edges))

    def bin_of(played: MatchResult) -> Integers:
        values = value(played)
        index = np.searchsorted(np.asarray(edges), values, side="right") - 1
        return np.where(np.isnan(values), len(names) if without else -1, index)

    return Breakdown(title, (*names, without) if without else names, bin_of)


_DEPTHS, _SIDES = ("short", "middle", "deep"), ("right", "centre", "left")


def _target_of(played: MatchResult) -> Integers:
    """Return which ninth of the opponent's court the target lies in (n,), with left and right from the robot's side."""
    depth = np.clip(played.targets[:, 0] / TABLE_HALF_LENGTH * 3, 0, 2).astype(np.int64)
    side = np.clip((played.targets[:, 1] / TABLE_HALF_WIDTH + 1) * 1.5, 0, 2).astype(np.int64)
    return 3 * depth + side


NEVER: Final = (
    "never"  # the ball bounces twice before, or drops beside the table: only above the table can it be caught
)

BREAKDOWNS: Final[dict[str, Breakdown]] = {
    "kind": Breakdown(
        "kind of ball",
        tuple(kind.name.lower() for kind in Kind),
        lambda played: played.launches[:, KIND].astype(np.int64),
    ),
    "speed": _by_edges("speed at launch [m/s]", (-_INF, 4, 5, 6, 7, 8, 10, 13, 16, _INF), speeds),
    "spin": _by_edges("spin [rad/s]", (-_INF, 40, 60, 80, 100, 150, 200, 250, 300, 450, 600, _INF), spins),
    "spin_kind": Breakdown("kind of spin", SPIN_KINDS, spin_kinds),
    "arrival_y": _by_edges(
        "arrival at the table's end, y [m]",
        (-_INF, -0.9, -0.6, -0.3, 0, 0.3, 0.6, 0.9, _INF),
        lambda played: played.arrivals[:, 1],
        NEVER,
    ),
    "arrival_height": _by_edges(
        "arrival at the table's end, height [m]",
        (-_INF, 0, 0.1, 0.2, 0.3, 0.4, _INF),
        lambda played: played.arrivals[:, 2],
        NEVER,
    ),
    "target": Breakdown(
        "target on the opponent's court",
        tuple(f"{depth} {side}" for depth in _DEPTHS for side in _SIDES),
        _target_of,
    ),
}
"""Every breakdown by its key in the JSON."""


def breakdown(played: MatchResult) -> dict[str, list[dict[str, Any]]]:
    """Return the measures by kind of ball, ready for JSON: for each of BREAKDOWNS its bins with SHOWN."""
    found: dict[str, list[dict[str, Any]]] = {}
    for key, kind in BREAKDOWNS.items():
        index = kind.bin_of(played)
        found[key] = [
            {"bin": name} | {shown: measures_of[shown] for shown in SHOWN}
            for k, name in enumerate(kind.bins)
            if (index == k).any() and (measures_of := measures(played.of(index == k)))
        ]
    return found


def survival(played: MatchResult) -> dict[str, Any]:
    """Return how long rallies last where an episode continues after a return, ready for JSON.

    ``rally_length_mean`` is the mean number of balls returned in a row, at most the rounds of an episode. It is the sum
    of ``survival``. ``rally_length_median`` is the largest number that at least half of the rallies reach.
    Each round's rate counts only balls that reached the round (Kaplan and Meier 1958). So episodes that the end of the
    evaluation cuts do not shorten it.
    """
    rounds: list[dict[str, Any]] = []
    reached, length, median = 1.0, 0.0, 0
    for number in range(1, int(played.rounds.max(initial=0)) + 1):
        here = played.of(played.rounds == number)
        found = measures(here)
        if not found["rallies"]:
            break
        returned = int((here.outcomes == Outcome.RETURNED).sum())
        reached *= returned / found["rallies"]
        length += reached
        median += reached >= 0.5
        rounds.append(
            {
                "round": number,
                "rallies": found["rallies"],
                "catch_rate": found["catch_rate"],
                "return_rate": found["return_rate"],
                "return_rate_ci": found["return_rate_ci"],
                "target_error_mean": found["target_error_mean"],
                "survival": round(reached, 4),
            }
        )
    return {"rally_length_mean": round(length, 4), "rally_length_median": median, "by_round": rounds}


def on_grid(points: Array, values: Array, edges: tuple[Array, Array]) -> tuple[Array, Integers]:
    """Return the mean of ``values`` in each cell of a grid, and the number of values in each.

    Args:
        points: (n, 2) [m]; points outside the grid don't count.
        values: (n,); nan doesn't count.
        edges: Of the cells along both axes, (a + 1,) and (b + 1,) [m].

    Returns:
        (a, b) means, nan in empty cells, and (a, b) counts.
    """
    known = np.isfinite(values) & np.isfinite(points).all(axis=1)
    x, y = points[known, 0], points[known, 1]
    count = np.histogram2d(x, y, bins=edges)[0]
    total = np.histogram2d(x, y, bins=edges, weights=values[known])[0]
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return mean, count.astype(np.int64)
