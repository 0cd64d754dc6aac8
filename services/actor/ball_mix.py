"""Which kind of ball an environment plays next, where a launch preset has several.

An environment plays one opponent after the other, and an opponent plays balls of one kind: so a robot can learn what
to expect of it (``expected_spin`` learnt). The kind of a new opponent is drawn so that kinds which are lost more often
are played more often: a curriculum over balls (compare Jiang et al. 2021, prioritized level replay).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.env.rally_env import FinishedRallies
from common.task.config import PresetName
from common.task.counter_rng import Stream, uniform
from common.task.launch_presets import PRESETS, Kind
from common.task.randomization import RallyParameter
from common.task.states import Outcome

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

OPPONENT_LEAVES: Final = 1 / 16  # [-] probability after each ball that another opponent comes
LOST_FLOOR: Final = 0.25  # [-] added to the share of lost balls, so that no kind is forgotten
MEMORY: Final = 500  # [balls] of one kind, over which the share of lost ones is averaged
_NOBODY: Final = -1


class BallMix:
    """The opponents of an actor's environments.

    Args:
        preset: Shares of the kinds before any ball was played.
        envs: Environments.
        seed: Of the opponents' coming and going.
    """

    def __init__(self, preset: PresetName, envs: int, seed: int) -> None:
        self._preset = np.zeros(len(Kind))
        self._preset[: len(PRESETS[preset])] = PRESETS[preset]
        self._lost = np.ones(len(Kind))  # [-] running share of lost balls
        self._due = np.zeros(len(Kind))  # [opponents] that each kind has too few of
        self._kind = np.full(envs, _NOBODY)
        self._seed, self._drawn = seed, 0

    @property
    def shares(self) -> Array:
        """Return the share of each kind among new opponents (6,)."""
        wanted = self._preset * (LOST_FLOOR + self._lost)
        shares: Array = wanted / wanted.sum()
        return shares

    def note(self, finished: FinishedRallies) -> None:
        """Take note of rallies that ended. Launches that were not validated don't count."""
        kinds = finished.parameters[:, RallyParameter.KIND].astype(np.int64)
        lost = finished.outcomes != Outcome.RETURNED
        for kind, is_lost in zip(kinds[finished.validated], lost[finished.validated], strict=True):
            self._lost[kind] += (float(is_lost) - self._lost[kind]) / MEMORY

    def next_kind(self, row: int, in_stock: Flags) -> int:
        """Return the kind of the next ball of environment ``row``: one of those in stock (6,), at least one."""
        self._drawn += 1
        kind = int(self._kind[row])
        stays = uniform(self._seed, Stream.KIND, self._drawn) >= OPPONENT_LEAVES
        if kind == _NOBODY or not (stays and in_stock[kind]):
            shares = self.shares
            self._due += shares
            # The kind of which most are missing: the shares hold at any time, and nothing is left to chance
            kind = int(np.argmax(np.where(in_stock & (shares > 0.0), self._due, -np.inf)))
            self._due[kind] -= 1.0
            self._kind[row] = kind
        return kind
