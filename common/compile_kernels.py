"""`python -m common.compile_kernels`: compile every kernel into the cache, so that no service starts by compiling."""

import sys
import time

import numpy as np

from common.env.local_rallies import LocalRallies
from common.env.rally_env import EnvConfig, RallyEnv


def compile_kernels() -> None:
    """Play a few steps; whatever runs in play is compiled after it."""
    env = RallyEnv(2, EnvConfig(), LocalRallies(seed=0))
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 7)))


if __name__ == "__main__":
    started = time.monotonic()
    compile_kernels()
    sys.stdout.write(f"kernels compiled in {time.monotonic() - started:.1f} s\n")
