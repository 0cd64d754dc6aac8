"""Valid rallies drawn in the process that plays them: for Gymnasium, benchmarks and tests."""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.env.rally_env import Launches
from common.task.config import TaskConfig
from common.task.launch import LAUNCH_SIZE, RallyBlock, draw_rallies

BLOCK: Final = 256  # rallies drawn at once: about 2 ms


class LocalRallies:
    """An endless source of valid rallies. The same arguments give the same rallies in every process.

    Args:
        seed: 0 .. 2^64 - 1.
        task: Its launch preset, randomization and flight are used.
    """

    def __init__(self, seed: int, task: TaskConfig = TaskConfig()) -> None:
        self._seed, self._task = seed, task
        self._next_block = 0
        self._block = RallyBlock(np.empty((0, LAUNCH_SIZE)), np.empty(0, np.uint64), 0)
        self._used = 0

    def take(self, rows: npt.NDArray[np.int64]) -> Launches:
        """Return the next rallies, one for each of the environments ``rows`` (n,)."""
        count = rows.size
        while len(self._block.seeds) - self._used < count:
            self._draw()
        used = slice(self._used, self._used + count)
        self._used += count
        return Launches(self._block.launches[used], self._block.seeds[used], np.ones(count, np.bool_))

    def _draw(self) -> None:
        """Append another block to the rallies that are left."""
        drawn = draw_rallies(BLOCK, self._task, seed=self._seed, block=self._next_block)
        self._next_block += 1
        self._block = RallyBlock(
            np.concatenate([self._block.launches[self._used :], drawn.launches]),
            np.concatenate([self._block.seeds[self._used :], drawn.seeds]),
            drawn.drawn,
        )
        self._used = 0
