"""`python -m common.compile_kernels`: compile every kernel into the cache, so that no service starts by compiling."""

import sys
import time

import numpy as np

from common.env.local_rallies import LocalRallies
from common.env.rally_env import EnvConfig, RallyEnv
from common.physics.flight import SIMPLE
from common.rally.launch import LAUNCH_SIZE
from common.rally.noise import CONDITIONS
from common.rally.undisturbed import undisturbed


def compile_kernels() -> None:
    """Play a few steps; whatever runs in play or in a match is compiled after it."""
    env = RallyEnv(2, EnvConfig(), LocalRallies(seed=0))
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 7)))
    undisturbed(np.ones((1, LAUNCH_SIZE)), np.ones((1, CONDITIONS)), SIMPLE)


if __name__ == "__main__":
    started = time.monotonic()
    compile_kernels()
    sys.stdout.write(f"kernels compiled in {time.monotonic() - started:.1f} s\n")
