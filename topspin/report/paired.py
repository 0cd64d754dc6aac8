"""Differences between experiments whose runs share seeds: mean, 95 % interval and p-value of a paired t-test.

Runs of one seed start from the same network and play the same measured balls. So a difference is taken seed by seed,
and the spread of these differences says how sure their mean is. With three seeds an interval is wide: 2.5 times the
standard deviation of the differences to each side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy import stats

from topspin.report.results import GroupResult, by_seed

COMPARED: Final = ("return_rate", "return_after_catch", "target_error_mean")
"""Measures whose differences are reported."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Mean of b - a over pairs."""

    mean: float
    low: float | None  # 95 % interval; None: all differences are equal, and say nothing about their spread
    high: float | None
    p: float | None  # two-sided
    pairs: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two experiments by one measure."""

    first: str  # label
    second: str
    measure: str
    difference: Difference  # second - first


def difference(a: Sequence[float], b: Sequence[float]) -> Difference:
    """Return the mean of b - a with its interval and p-value (Student's t for pairs).

    Raises:
        ValueError: Fewer than two pairs, or numbers that do not pair.
    """
    if len(a) != len(b) or len(a) < 2:
        raise ValueError(f"{len(a)} and {len(b)} values; allowed: two or more pairs")
    apart = np.subtract(b, a)
    if np.ptp(apart) <= np.spacing(np.abs([*a, *b]).max()):  # no spread: the test has no denominator
        return Difference(float(apart.mean()), None, None, None, len(apart))
    test = stats.ttest_rel(b, a)
    interval = test.confidence_interval(0.95)
    return Difference(
        float(apart.mean()), float(interval.low), float(interval.high), float(test.pvalue), len(apart)
    )


def over_seeds(a: Mapping[int, float], b: Mapping[int, float]) -> Difference | None:
    """Return the mean of b - a over the seeds that both have, or None if these are fewer than two."""
    seeds = sorted(a.keys() & b.keys())
    return difference([a[seed] for seed in seeds], [b[seed] for seed in seeds]) if len(seeds) > 1 else None


def comparisons(groups: Sequence[GroupResult]) -> list[Comparison]:
    """Return all differences between experiments that share two or more seeds."""
    found = []
    for one, other in combinations(groups, 2):
        for measure in COMPARED:
            apart = over_seeds(*(by_seed(group.runs, measure) for group in (one, other)))
            if apart is not None:
                found.append(Comparison(one.label, other.label, measure, apart))
    return found
