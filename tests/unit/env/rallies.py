"""Environments and rallies for the tests."""

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvStep, Launches, RallyEnv
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import RallyBlock, draw_rallies
from common.task.states import State

QUIET = TaskConfig(randomization="off", carry_over=0.0, reset_spread=0.0)
"""Without randomization, and every episode begins at home."""

PLAYED_OUT = ExperienceConfig(continue_share=0.0, end_at_hit_share=0.0)
"""Every rally is played to its end as in a match, and hits are corrected."""


class Deck:
    """A source that gives the rallies of a block in order. After the last one the first comes again."""

    def __init__(self, block: RallyBlock, first: int = 0, stride: int = 1, validated: bool = True) -> None:
        self.block = block
        self.next, self.stride, self.validated = first, stride, validated

    def take(self, rows: npt.NDArray[np.int64]) -> Launches:
        count = rows.size
        index = (self.next + self.stride * np.arange(count)) % len(self.block.seeds)
        self.next += self.stride * count
        return Launches(
            self.block.launches[index], self.block.seeds[index], np.full(count, self.validated, np.bool_)
        )


def make_env(
    count: int = 4,
    task: TaskConfig = QUIET,
    experience: ExperienceConfig = PLAYED_OUT,
    seed: int = 1,
    rallies: int = 64,
    **options,
) -> RallyEnv:
    """Return an environment that plays ``rallies`` paper balls again and again."""
    balls = TaskConfig(randomization=task.randomization)
    source = Deck(draw_rallies(rallies, balls, seed=seed))
    return RallyEnv(count, task, source, experience=experience, **options)


def hold(env: RallyEnv) -> npt.NDArray[np.float32]:
    """Return actions (B, 7) that hold the robots at home."""
    return np.tile(env.home_action, (env.count, 1))


def random_actions(env: RallyEnv, steps: int, seed: int = 0, spread: float = 0.3) -> npt.NDArray[np.float32]:
    """Return (steps, B, 7) actions around home."""
    rng = np.random.default_rng(seed)
    noise = spread * rng.standard_normal((steps, env.count, 7))
    return (env.home_action + noise).astype(np.float32)


def play_until_end(env: RallyEnv, row: int = 0, steps: int = 200) -> EnvStep:
    """Hold the robots at home until the rally of a row ends, and return the last step."""
    for _ in range(steps):
        step = env.step(hold(env))
        if row in step.finished.rows:
            return step
    raise AssertionError("no rally ended")


def drop_on(env: RallyEnv, x: float, row: int = 0) -> None:
    """Put the ball of a row, as after a hit, above the table at ``x``."""
    env.rallies.ball[row] = [x, 0.1, 0.1, 0, 0, 0, 0, 0, 0]
    env.rallies.state[row] = State.TAU_23
    env.rallies.caught[row] = True
