"""The search: every state within the bounds, nearest first, each checked."""

import sys
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from threading import Event
from typing import Final

from benchmarks.exchange.invariants import faults, is_stuck
from benchmarks.exchange.model import Bounds, State, first_state, steps
from common.evaluation.evaluate import check

PROGRESS_S: Final = 5.0


@dataclass(slots=True)
class Search:
    """What a search has found."""

    states: int = 0
    steps: int = 0
    ends: int = 0
    depth: int = 0
    is_whole: bool = True
    kinds: Counter[str] = field(default_factory=Counter)
    broken: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)  # invariant, and the path to it


def explore(bounds: Bounds, most: int, stop: Event | None = None) -> Search:
    """Visit every state within the bounds, nearest first, but at most ``most``."""
    first = first_state()
    came: dict[State, tuple[State, str] | None] = {first: None}
    waiting = deque([(first, 0)])
    found = Search()
    told = time.monotonic()
    while waiting:
        state, depth = waiting.popleft()
        next_ones = [(name, after) for name, after in steps(state, bounds) if after != state]
        _note(found, state, depth, next_ones, bounds, came)
        for name, after in next_ones:
            if after in came:
                continue
            if len(came) >= most:
                found.is_whole = False
                break
            came[after] = (state, name)
            waiting.append((after, depth + 1))
        if stop is not None:
            check(stop)
            if time.monotonic() - told > PROGRESS_S:
                told = time.monotonic()
                print(f"states={found.states} waiting={len(waiting)} depth={depth}", file=sys.stderr)
    return found


def _note(
    found: Search,
    state: State,
    depth: int,
    next_ones: Sequence[tuple[str, State]],
    bounds: Bounds,
    came: Mapping[State, tuple[State, str] | None],
) -> None:
    """Count a state, and check it."""
    found.states += 1
    found.depth = max(found.depth, depth)
    found.steps += len(next_ones)
    found.kinds.update(name for name, _ in next_ones)
    broken = faults(state)
    if not next_ones:
        found.ends += 1
        if is_stuck(state, bounds):
            broken.append("nobody waits for ever")
    found.broken += [(fault, path_to(state, came)) for fault in broken]


def path_to(state: State, came: Mapping[State, tuple[State, str] | None]) -> tuple[str, ...]:
    """Return the steps that lead to a state."""
    names: list[str] = []
    while (before := came[state]) is not None:
        state, name = before
        names.append(name)
    return tuple(reversed(names))
