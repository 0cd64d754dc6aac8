"""Environment steps per second on one thread, and their share of MuJoCo's own speed.

    python -m benchmarks.env --json

An environment step is everything that a frame needs except the network: robot with contacts, ball, touches, reward,
perception, observation, resets. MuJoCo's own speed is ``Batch.step`` of the same model with the same actions and time
step. Short slices of both alternate, so that a busy machine slows both alike. Rates and ratio are medians.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from threading import Event

import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch
from pydantic import Field

from benchmarks.paired import paired
from benchmarks.settings import TimedConfig, run
from common.env.rally_env import Launches, RallyEnv
from common.robot.model import load_model
from common.task.config import Randomization, TaskConfig
from common.task.launch import RallyBlock, draw_rallies

RALLIES = 20_000  # drawn before the measurement, and repeated
ACTIONS = 64  # control steps of actions, repeated
SPREAD = (
    0.2  # [half-range] standard deviation of the actions around home, as of a policy with exploration noise
)
SLICE = 10  # control steps of one measured slice: about 100 ms

Actions = npt.NDArray[np.float32]


class MemoryRallies:
    """Rallies that are drawn in advance, so that drawing them is not measured."""

    def __init__(self, block: RallyBlock) -> None:
        self._block, self._next = block, 0

    def take(self, rows: npt.NDArray[np.int64]) -> Launches:
        """Return the next rallies, one for each of ``rows`` (n,). After the last one the first comes again."""
        count = rows.size
        index = np.arange(self._next, self._next + count) % len(self._block.seeds)
        self._next += count
        return Launches(self._block.launches[index], self._block.seeds[index], np.ones(count, np.bool_))


@dataclass(frozen=True, slots=True)
class Speed:
    """Result of one run: medians over slices."""

    env_steps_per_s: float
    mujoco_steps_per_s: float  # control steps, as for the environment
    ratio: float  # median of the slices' ratios
    substeps: int


def play(step: Callable[[Actions], object], actions: Actions) -> None:
    """Take a control step with each of ``actions``."""
    for action in actions:
        step(action)


def bare_mujoco(env: RallyEnv) -> Callable[[Actions], None]:
    """Return a function that plays one control step of the environment's robots with MuJoCo alone."""
    robot = env.robot
    batch = Batch(load_model(env.task.robot, robot.step_s), env.count, 1)
    batch.reset(keyframe=0)
    ctrl = batch.bind("ctrl")

    def step(action: Actions) -> None:
        ctrl[:] = robot.middle + robot.half_range * action
        batch.step(nstep=robot.substeps)

    return step


def measure(envs: int, randomization: str, seconds: float, seed: int) -> Speed:
    """Play for ``seconds`` and return the speeds."""
    task = TaskConfig.model_validate({"randomization": randomization})
    env = RallyEnv(envs, task, MemoryRallies(draw_rallies(RALLIES, task, seed=seed)), threads=1)
    rng = np.random.default_rng(seed)
    noise = SPREAD * rng.standard_normal((ACTIONS, envs, 7))
    actions = np.clip(env.home_action + noise, -1.0, 1.0).astype(np.float32)
    mujoco = bare_mujoco(env)
    env.reset()
    for step in (env.step, mujoco):
        play(step, actions)  # compiles the kernels, and spreads the rallies over their phases
    ours, theirs = (slices(step, actions) for step in (env.step, mujoco))
    measured = paired(ours, theirs, seconds)
    env_rate, mujoco_rate = (SLICE * envs / duration for duration in (measured.seconds, measured.limit))
    return Speed(env_rate, mujoco_rate, measured.share, env.robot.substeps)


def slices(step: Callable[[Actions], object], actions: Actions) -> Callable[[], None]:
    """Return a function that takes the next ``SLICE`` control steps; after the last action the first comes again."""
    starts = count(0, SLICE)
    return lambda: play(step, actions[(np.arange(SLICE) + next(starts)) % len(actions)])


class EnvConfig(TimedConfig):
    """Measure the speed of the environment on one thread, and compare it with MuJoCo's own step of the same robots."""

    envs: int = Field(512, ge=1, le=65536, description="robots in the batch")
    randomization: Randomization = Field("standard", description="profile of what differs between rallies")


def main(config: EnvConfig, _stop: Event) -> int:
    """Measure and print."""
    speed = measure(config.envs, config.randomization, config.seconds, config.seed)
    if config.json_line:
        print(
            json.dumps(
                {
                    "env_steps_per_s": round(speed.env_steps_per_s),
                    "mujoco_steps_per_s": round(speed.mujoco_steps_per_s),
                    "ratio": round(speed.ratio, 4),
                    "substeps": speed.substeps,
                    "envs": config.envs,
                    "randomization": config.randomization,
                    "seconds": config.seconds,
                }
            )
        )
    else:
        print(
            f"{speed.env_steps_per_s:,.0f} environment steps/s, {speed.ratio:.1%} of MuJoCo's own "
            f"{speed.mujoco_steps_per_s:,.0f} ({config.envs} environments, {speed.substeps} substeps, "
            f"randomization {config.randomization})"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("env", EnvConfig, main))
