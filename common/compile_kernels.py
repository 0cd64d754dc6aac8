"""`python -m common.compile_kernels`: compile every kernel into the cache, so that no service starts by compiling."""

import sys
import time

import numpy as np

from common.env.rally_env import EnvConfig, Launches, RallyEnv
from common.rally.launch import RallyBlock, draw_rallies


class _Repeat:
    """A source that deals the same few rallies again and again."""

    def __init__(self, block: RallyBlock) -> None:
        self._block = block

    def take(self, count: int) -> Launches:
        rows = np.arange(count) % len(self._block.seeds)
        return Launches(self._block.launches[rows], self._block.seeds[rows], np.ones(count, np.bool_))


def compile_kernels() -> None:
    """Play a few steps; whatever runs in play is compiled after it."""
    env = RallyEnv(2, EnvConfig(), _Repeat(draw_rallies(2, seed=0)))
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 7)))


if __name__ == "__main__":
    started = time.monotonic()
    compile_kernels()
    sys.stdout.write(f"kernels compiled in {time.monotonic() - started:.1f} s\n")
