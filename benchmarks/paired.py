"""Rates that are measured against their limit: slices of both alternate, so that a busy machine slows both alike."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Paired:
    """Durations of the slices of a task and of its limit; medians."""

    seconds: float  # of the task
    limit: float  # [s] of the limit
    share: float  # limit / task: 1 would be as fast as the limit


def seconds_of(act: Callable[[], object]) -> float:
    """Return the duration of a call [s]."""
    start = time.perf_counter()
    act()
    return time.perf_counter() - start


def paired(task: Callable[[], object], limit: Callable[[], object], seconds: float) -> Paired:
    """Call both in turn for ``seconds``, at least three times, after one call of each to warm up.

    The other one begins in every second turn.
    """
    task(), limit()
    taken: list[tuple[float, float]] = []
    start = time.perf_counter()
    while len(taken) < 3 or time.perf_counter() - start < seconds:
        if len(taken) % 2 == 0:
            own_s, limit_s = seconds_of(task), seconds_of(limit)
        else:
            limit_s, own_s = seconds_of(limit), seconds_of(task)
        taken.append((own_s, limit_s))
    both = np.array(taken)
    own, bound = np.median(both, axis=0)
    return Paired(float(own), float(bound), float(np.median(both[:, 1] / both[:, 0])))
