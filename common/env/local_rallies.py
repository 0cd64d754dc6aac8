"""Valid rallies drawn where they are played: for Gymnasium, benchmarks and tests, with no generator about."""

import numpy as np

from common.env.rally_env import Launches
from common.physics.flight import SIMPLE
from common.rally.launch import LAUNCH_SIZE, RallyBlock, draw_rallies

BLOCK = 256  # rallies drawn at once: some 2 ms


class LocalRallies:
    """An endless source of valid rallies: a function of its arguments, in every process the same.

    Args:
        seed: 0 .. 2^64 - 1.
        preset: A key of ``launch_presets.PRESETS``.
        noise: A key of ``noise.PROFILES``.
        model: ``flight.SIMPLE`` or ``flight.FULL``, as the environment flies them.
    """

    def __init__(
        self, seed: int, preset: str = "paper", noise: str = "standard", model: int = SIMPLE
    ) -> None:
        self._seed, self._preset, self._noise, self._model = seed, preset, noise, model
        self._next_block = 0
        self._block = RallyBlock(np.empty((0, LAUNCH_SIZE)), np.empty(0, np.uint64), 0)
        self._used = 0

    def take(self, count: int) -> Launches:
        """Return the next ``count`` rallies."""
        while len(self._block.seeds) - self._used < count:
            self._draw()
        rows = slice(self._used, self._used + count)
        self._used += count
        return Launches(self._block.launches[rows], self._block.seeds[rows], np.ones(count, np.bool_))

    def _draw(self) -> None:
        """Put another block behind what is left."""
        drawn = draw_rallies(
            BLOCK,
            seed=self._seed,
            block=self._next_block,
            preset=self._preset,
            noise=self._noise,
            model=self._model,
        )
        self._next_block += 1
        self._block = RallyBlock(
            np.concatenate([self._block.launches[self._used :], drawn.launches]),
            np.concatenate([self._block.seeds[self._used :], drawn.seeds]),
            drawn.drawn,
        )
        self._used = 0
