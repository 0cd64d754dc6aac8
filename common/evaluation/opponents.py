"""Rallies in the order in which their opponents play them, so that a match does not depend on its environments."""

from collections import deque
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from common.env.rally_env import Launches
from common.rally.state import NO_SAMPLE
from common.task.launch import RallyBlock

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

EQUAL_BATCH = 64  # rows; a batch's size changes the last bits of a network's output, and so the rallies


FILLED = -1  # in place of a rally's number: a filler rally


class FilledDeck:
    """The launches of chosen rallies, with filler rallies, which are not validated, where none is chosen.

    Args:
        rallies: The n rallies.
        filler: Rallies for environments that have nothing else to play, used in turn.
    """

    def __init__(self, rallies: RallyBlock, filler: RallyBlock) -> None:
        self._rallies, self._filler = rallies, filler
        self._filled = 0

    def launches(self, dealt: Integers, strangers: Flags | None = None) -> Launches:
        """Return the launches of rallies ``dealt`` (m,), numbers or ``FILLED``; ``strangers`` as for `Launches`."""
        is_fresh = dealt != FILLED
        fresh = dealt[is_fresh]
        extra = (self._filled + np.arange(len(dealt) - len(fresh))) % len(self._filler.seeds)
        self._filled += len(extra)
        launches = np.empty((len(dealt), self._rallies.launches.shape[1]))
        seeds = np.empty(len(dealt), np.uint64)
        launches[is_fresh], seeds[is_fresh] = self._rallies.launches[fresh], self._rallies.seeds[fresh]
        launches[~is_fresh], seeds[~is_fresh] = self._filler.launches[extra], self._filler.seeds[extra]
        paths = None
        if self._rallies.paths is not None:  # filler rallies have no recorded track
            paths = np.full((len(dealt), *self._rallies.paths.shape[1:]), NO_SAMPLE)
            paths[is_fresh] = self._rallies.paths[fresh]
        return Launches(launches, seeds, is_fresh, paths, strangers)


class OpponentRallies:
    """A source that gives an environment all balls of one opponent in their order, and then those of the next.

    Each opponent is a stranger at first. Environments without an opponent play filler rallies, which are not validated.

    Args:
        rallies: The n rallies.
        opponents: (n,) number of each rally's opponent.
        filler: Rallies for environments that have nothing else to play.
    """

    def __init__(self, rallies: RallyBlock, opponents: Integers, filler: RallyBlock) -> None:
        self._deck = FilledDeck(rallies, filler)
        # those with most balls first: the match takes as long as the last one
        numbers, counts = np.unique(opponents, return_counts=True)
        self._waiting = deque(
            deque(np.flatnonzero(opponents == number).tolist())
            for number in numbers[np.argsort(-counts, kind="stable")]
        )
        self._playing: dict[int, deque[int]] = {}

    def take(self, rows: Integers) -> Launches:
        """Return the next launches, one for each of the environments ``rows`` (n,)."""
        count = rows.size
        dealt, strangers = np.full(count, FILLED), np.ones(count, np.bool_)
        for k, row in enumerate(rows.tolist()):
            if self._playing.get(row):
                strangers[k] = False
            elif self._waiting:
                self._playing[row] = self._waiting.popleft()
            else:
                continue
            dealt[k] = self._playing[row].popleft()
        return self._deck.launches(dealt, strangers)


def in_equal_batches(act: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    """Return a policy that acts on ``EQUAL_BATCH`` rows at a time, so that a row's action is the same in any batch."""

    def acting(obs: Floats) -> Floats:
        rows = len(obs)
        padded = np.zeros((-(-rows // EQUAL_BATCH) * EQUAL_BATCH, obs.shape[1]), obs.dtype)
        padded[:rows] = obs
        parts = [act(padded[k : k + EQUAL_BATCH]) for k in range(0, len(padded), EQUAL_BATCH)]
        return np.concatenate(parts)[:rows]

    return acting
