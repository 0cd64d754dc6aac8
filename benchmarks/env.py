"""How many environment steps a second one thread plays, and what share of MuJoCo's own speed that is.

    python -m benchmarks.env --json

An environment step is everything a frame needs but the network: robot with contacts, ball, touches, reward, noise,
observation, resets. MuJoCo's own speed is ``Batch.step`` of the same model under the same actions with the same
time step. Short slices of both take turns, so that a busy machine slows both alike; rates and ratio are medians.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from common.env.rally_env import EnvConfig, Launches, RallyEnv
from common.env.robot import load_model
from common.rally.launch import RallyBlock, draw_rallies
from common.rally.noise import PROFILES

RALLIES = 20_000  # drawn before the clock starts; dealt again from the first when they are used up
ACTIONS = 64  # control steps of actions, played in a circle
SPREAD = 0.2  # [half-range] of the actions about home: a policy that explores
SLICE = 10  # control steps of one measured slice: some 100 ms

Actions = npt.NDArray[np.float32]


class MemoryRallies:
    """Rallies that are there already, so that drawing them isn't measured."""

    def __init__(self, block: RallyBlock) -> None:
        self._block, self._next = block, 0

    def take(self, count: int) -> Launches:
        """Return the next ``count`` rallies, from the first again after the last."""
        index = np.arange(self._next, self._next + count) % len(self._block.seeds)
        self._next += count
        return Launches(self._block.launches[index], self._block.seeds[index], np.ones(count, np.bool_))


@dataclass(frozen=True, slots=True)
class Speed:
    """What one run measured; medians over slices."""

    env_steps_per_s: float
    mujoco_steps_per_s: float  # in control steps, as the environment's
    ratio: float  # median of the slices' ratios
    substeps: int


def seconds_of(step: Callable[[Actions], object], actions: Actions) -> float:
    """Return how long a slice takes."""
    start = time.perf_counter()
    for action in actions:
        step(action)
    return time.perf_counter() - start


def bare_mujoco(env: RallyEnv) -> Callable[[Actions], None]:
    """Return a function that plays one control step of the environment's robots with nothing but MuJoCo."""
    robot = env.robot
    batch = Batch(load_model(env.config.robot, robot.step_s), env.count, 1)
    batch.reset(keyframe=0)
    ctrl = batch.bind("ctrl")

    def step(action: Actions) -> None:
        ctrl[:] = robot.middle + robot.half_range * action
        batch.step(nstep=robot.substeps)

    return step


def measure(envs: int, noise: str, seconds: float, seed: int) -> Speed:
    """Play for ``seconds`` and return the speeds."""
    config = EnvConfig.model_validate({"noise": noise})
    env = RallyEnv(envs, config, MemoryRallies(draw_rallies(RALLIES, seed=seed, noise=noise)), threads=1)
    rng = np.random.default_rng(seed)
    noise_of_actions = SPREAD * rng.standard_normal((ACTIONS, envs, 7))
    actions = np.clip(env.home_action + noise_of_actions, -1.0, 1.0).astype(np.float32)
    mujoco = bare_mujoco(env)
    env.reset()
    for step in (env.step, mujoco):
        seconds_of(step, actions)  # compiles, and spreads the rallies over their phases
    slices: list[tuple[float, float]] = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        part = actions[(np.arange(SLICE) + SLICE * len(slices)) % ACTIONS]
        slices.append((seconds_of(env.step, part), seconds_of(mujoco, part)))
    taken = np.array(slices)
    env_rate, mujoco_rate = SLICE * envs / np.median(taken, axis=0)
    return Speed(
        float(env_rate), float(mujoco_rate), float(np.median(taken[:, 1] / taken[:, 0])), env.robot.substeps
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Return the command line's options."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.env",
        description="Measure the environment on one thread against MuJoCo's own step of the same robots.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--envs", type=int, default=512, metavar="B", help="robots in the batch, 1 or more")
    parser.add_argument("--noise", choices=PROFILES, default="standard", help="what differs between rallies")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="how long to measure, > 0")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of rallies and actions, 0 or more")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args(arguments)
    if options.envs < 1:
        parser.error(f"--envs: got {options.envs}; allowed: 1 or more")
    if options.seed < 0:
        parser.error(f"--seed: got {options.seed}; allowed: 0 or more")
    if not options.seconds > 0.0:
        parser.error(f"--seconds: got {options.seconds}; allowed: more than 0")
    return options


def main() -> None:
    """Measure and print."""
    options = parse()
    speed = measure(options.envs, options.noise, options.seconds, options.seed)
    if options.json:
        print(
            json.dumps(
                {
                    "env_steps_per_s": round(speed.env_steps_per_s),
                    "mujoco_steps_per_s": round(speed.mujoco_steps_per_s),
                    "ratio": round(speed.ratio, 4),
                    "substeps": speed.substeps,
                    "envs": options.envs,
                    "noise": options.noise,
                    "seconds": options.seconds,
                }
            )
        )
    else:
        print(
            f"{speed.env_steps_per_s:,.0f} environment steps/s, {speed.ratio:.1%} of MuJoCo's own "
            f"{speed.mujoco_steps_per_s:,.0f} ({options.envs} environments, {speed.substeps} substeps, "
            f"noise {options.noise})"
        )


if __name__ == "__main__":
    main()
