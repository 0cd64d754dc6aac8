"""Speed of one actor's playing, without messages, and its share of MuJoCo's own speed.

    python -m benchmarks.actor --json

It plays rollouts as an actor does: inference, noise, environment, the way home. The limit is ``Batch.step`` of the
same robots with the same actions. Both alternate on one thread.
"""

import json
import sys
from collections.abc import Callable
from threading import Event

import numpy as np
from pydantic import Field

from benchmarks.env import bare_mujoco
from benchmarks.paired import paired
from benchmarks.play import HORIZON, make_player, make_training
from benchmarks.settings import TimedConfig, run
from common.comms.codec import encode
from common.comms.messages import Rollout
from services.actor.player import Player
from services.learner.config import PPOConfig


def playing(player: Player) -> Callable[[], Rollout]:
    """Return a function that plays the next rollout."""
    sequence = iter(range(2**31))
    return lambda: player.play("benchmark", 1, next(sequence))


def measure(envs: int, seconds: float, seed: int) -> dict[str, float]:
    """Play for ``seconds`` and return the figures."""
    player = make_player(make_training(PPOConfig(), seed), envs, seed)
    play, step = playing(player), bare_mujoco(player.env)
    actions = np.clip(play().actions, -1.0, 1.0)

    def mujoco() -> None:
        for action in actions:
            step(action)

    measured = paired(play, mujoco, seconds)
    rollouts = [play() for _ in range(3)]
    inference = float(np.median([rollout.seconds["inference"] for rollout in rollouts]))
    return {
        "frames_per_s": round(HORIZON * envs / measured.seconds, 1),
        "mujoco_frames_per_s": round(HORIZON * envs / measured.limit, 1),
        "ratio": round(measured.share, 4),
        "inference_share": round(inference / measured.seconds, 4),
        "bytes_per_frame": round(len(encode(rollouts[0])) / (HORIZON * envs), 1),
        "envs": envs,
    }


class ActorBenchmarkConfig(TimedConfig):
    """Measure how fast one actor plays, and compare it with MuJoCo's own step of the same robots."""

    envs: int = Field(256, ge=1, le=65536, description="environments of the actor")


def main(config: ActorBenchmarkConfig, _stop: Event) -> int:
    """Measure and print."""
    result = measure(config.envs, config.seconds, config.seed)
    if config.json_line:
        print(json.dumps(result))
    else:
        print(
            f"{result['frames_per_s']:,.0f} frames/s, {result['ratio']:.1%} of MuJoCo's own "
            f"{result['mujoco_frames_per_s']:,.0f} ({config.envs} environments); inference "
            f"{result['inference_share']:.1%}; {result['bytes_per_frame']:.0f} bytes a frame"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("actor", ActorBenchmarkConfig, main))
