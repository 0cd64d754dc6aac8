"""`python -m topspin.compile_kernels`: compile every kernel into the cache, so that no service starts by compiling."""

import sys
import time

import numpy as np

from common.env.local_rallies import LocalRallies
from common.env.rally_env import RallyEnv
from common.evaluation.unplayed_flight import unplayed_flight
from common.physics.flight_model import Flight
from common.task.config import TaskConfig
from common.task.launch import LAUNCH_SIZE
from common.task.randomization import RALLY_PARAMETERS


def compile_kernels() -> None:
    """Play a few steps: that compiles all kernels of play and of a match."""
    env = RallyEnv(2, TaskConfig(), LocalRallies(seed=0))
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 7)))
    unplayed_flight(np.ones((1, LAUNCH_SIZE)), np.ones((1, RALLY_PARAMETERS)), Flight.FULL)


if __name__ == "__main__":
    started = time.monotonic()
    compile_kernels()
    sys.stdout.write(f"kernels compiled in {time.monotonic() - started:.1f} s\n")
