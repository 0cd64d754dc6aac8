"""Rallies for the tests of pictures: recorded from the environment, or made up."""

import numpy as np

from common.env.robot import home_action
from common.evaluation.rally_recorder import RecordedRally, record_rallies
from common.task.config import TaskConfig
from common.task.launch import RallyBlock, draw_rallies
from common.task.states import Outcome
from topspin.render.replay import Moment

HOME = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0])
NEAR_HOME = TaskConfig(randomization="standard", carry_over=0.5)


def wave(obs):
    """A policy without weights: holds the racket at the ball's y, and moves forward when the ball is near."""
    actions = np.tile(home_action(), (len(obs), 1))
    actions[:, 1] = obs[:, 25] / 0.9
    actions[:, 0] = np.where(obs[:, 24] < -0.5, 0.8, 0.0)
    return actions.astype(np.float32)


def make_block(count: int, seed: int = 3) -> RallyBlock:
    return draw_rallies(count, seed=seed)


def make_recorded(count: int = 4, seed: int = 3) -> list[RecordedRally]:
    return record_rallies(wave, make_block(count, seed), NEAR_HOME)


def make_rally(steps: int = 20, vel=(-4.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), **changes) -> RecordedRally:
    """Return a ball that flies straight, without gravity, with a robot at home."""
    time = 0.005 * np.arange(steps)
    values = {
        "seed": 1,
        "outcome": Outcome.MISS,
        "target": np.array([0.7, 0.2]),
        "landing": np.full(2, np.nan),
        "landing_error": float("nan"),
        "time": time,
        "joints": np.tile(HOME, (steps, 1)),
        "ball_pos": np.array([0.5, 0.0, 0.3]) + time[:, None] * np.array(vel),
        "ball_vel": np.tile(np.array(vel), (steps, 1)),
        "ball_spin": np.tile(np.array(spin), (steps, 1)),
        "ball_turn": np.tile([1.0, 0.0, 0.0, 0.0], (steps, 1)),
        "state": np.zeros(steps, np.int64),
    }
    return RecordedRally(**(values | changes))


def make_moment(**changes) -> Moment:
    values = {
        "joints": HOME,
        "ball_pos": np.array([0.3, 0.1, 0.4]),
        "ball_turn": np.array([1.0, 0.0, 0.0, 0.0]),
        "ball_spin": np.zeros(3),
        "target": np.array([0.7, 0.2]),
    }
    return Moment(**(values | changes))
