"""Rallies for the tests of the environment."""

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvConfig, Launches, RallyEnv
from common.rally.launch import RallyBlock, draw_rallies

QUIET = EnvConfig(noise="off", carry_over=0.0, go_on=0.0, reset_spread=0.0, foresee=0.0)
"""No noise, and every episode begins at home."""


class Deck:
    """A source that deals a block of rallies in order, and from its beginning again."""

    def __init__(self, block: RallyBlock, first: int = 0, stride: int = 1, validated: bool = True) -> None:
        self.block = block
        self.next, self.stride, self.validated = first, stride, validated

    def take(self, count: int) -> Launches:
        index = (self.next + self.stride * np.arange(count)) % len(self.block.seeds)
        self.next += self.stride * count
        return Launches(
            self.block.launches[index], self.block.seeds[index], np.full(count, self.validated, np.bool_)
        )


def make_env(
    count: int = 4, config: EnvConfig = QUIET, seed: int = 1, rallies: int = 64, **options
) -> RallyEnv:
    return RallyEnv(count, config, Deck(draw_rallies(rallies, seed=seed, noise=config.noise)), **options)


def random_actions(env: RallyEnv, steps: int, seed: int = 0, spread: float = 0.3) -> npt.NDArray[np.float32]:
    """Return (steps, B, 7) actions around home."""
    rng = np.random.default_rng(seed)
    noise = spread * rng.standard_normal((steps, env.count, 7))
    return (env.home_action + noise).astype(np.float32)
