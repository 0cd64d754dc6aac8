"""Speed of a group of learners against one, from memory, and how far their parameters are apart.

    python -m benchmarks.learners --json

The same rollouts, played before, are trained by one learner and by a group of ranks, each with its share of them, in
turns. A rank has the frames that one learner trains by default, in minibatches that are as many times as large as there
are ranks. The group's parameters after three epochs, in float32, are compared with those of one learner.
"""

import json
import multiprocessing
import os
import sys
import time
from multiprocessing.connection import Connection
from threading import Event
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from benchmarks.play import make_player, make_training
from benchmarks.settings import TimedConfig, run
from common.comms.codec import decode, encode
from common.comms.messages import Rollout
from deploy.prepare import free_port
from services.learner.config import PPOConfig
from services.learner.group import join
from services.learner.ppo import precision_of

EPOCHS_COMPARED: Final = 3
WARM_UP: Final = 3  # epochs before the measurement
LONGEST_START_S: Final = 300.0

Floats = npt.NDArray[np.float32]


def _rank(
    rank: int,
    size: int,
    port: int,
    payloads: list[bytes],
    ppo: PPOConfig,
    seconds: float,
    results: Connection,
) -> None:
    """Train as one rank, and send frames/s of the group (0: not measured) and the parameters."""
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    group = join({"RANK": str(rank), "WORLD_SIZE": str(size)})
    training = make_training(ppo, seed=0, group=group)
    each = len(payloads) // size
    rollouts = [decode(payload, Rollout) for payload in payloads[each * rank : each * (rank + 1)]]
    epochs = WARM_UP if seconds else EPOCHS_COMPARED
    for _ in range(epochs):
        training.run_epoch(rollouts)
    frames, taken = 0, 0.0
    while taken < seconds:  # the ranks wait for each other in every gradient step, so their clocks agree
        started = time.perf_counter()
        frames += training.run_epoch(rollouts).frames
        mine = np.array([time.perf_counter() - started])
        taken += float(max(times[0] for (times,) in group.gathered(mine)))
    parameters = np.concatenate([p.detach().numpy().ravel() for p in training.network.parameters()])
    results.send((frames / taken if taken else 0.0, parameters))
    group.leave()


def train(size: int, payloads: list[bytes], ppo: PPOConfig, seconds: float) -> tuple[float, Floats]:
    """Return frames/s of a group of ``size`` ranks, and the parameters of the first after the warm-up and that time.

    Args:
        size: Ranks, each a process.
        payloads: Encoded rollouts, whose number ``size`` divides.
        ppo: Hyper-parameters.
        seconds: To measure; 0: train ``EPOCHS_COMPARED`` epochs.
    """
    port = free_port()
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    other, unused = context.Pipe(duplex=False)
    ranks = [
        context.Process(
            target=_rank, args=(rank, size, port, payloads, ppo, seconds, unused if rank else sender)
        )
        for rank in range(size)
    ]
    for process in ranks:
        process.start()
    if not receiver.poll(LONGEST_START_S + seconds):
        raise TimeoutError(f"{size} ranks gave no result in {LONGEST_START_S + seconds:.0f} s")
    found: tuple[float, Floats] = receiver.recv()
    for _ in range(size - 1):
        other.recv()
    for process in ranks:
        process.join()
    return found


def measure(ranks: int, envs: int, seconds: float, turns: int, seed: int) -> dict[str, float | int | str]:
    """Return the figures of a group of ``ranks``."""
    ppo = PPOConfig(minibatch=ranks * PPOConfig().minibatch)
    player = make_player(make_training(ppo, seed), envs, seed)
    payloads = [encode(player.play("benchmark", 1, sequence)) for sequence in range(ranks)]
    exact = ppo.model_copy(update={"precision": "float32"})
    alone, together = (train(size, payloads, exact, 0.0)[1] for size in (1, ranks))
    speeds = [[train(size, payloads, ppo, seconds / turns)[0] for size in (1, ranks)] for _ in range(turns)]
    one, group = np.median(np.array(speeds), axis=0)
    return {
        "ranks": ranks,
        "speedup": round(float(np.median([g / o for o, g in speeds])), 3),
        "frames_per_s": round(float(group), 1),
        "frames_per_s_alone": round(float(one), 1),
        "parameters_difference": float(np.abs(alone - together).max()),
        "epochs_compared": EPOCHS_COMPARED,
        "frames": 32 * envs * ranks,
        "minibatch": ppo.minibatch,
        "precision": precision_of(ppo),
    }


class LearnersConfig(TimedConfig):
    """Measure how much faster a group of learners trains than one, and compare their parameters."""

    ranks: int = Field(2, ge=2, le=64, description="learners of the group, each a process with a core")
    envs: int = Field(
        256, ge=1, le=65536, description="environments of each rank; a dataset has 32 frames of each"
    )
    turns: int = Field(3, ge=1, le=100, description="measurements of each, alternating")


def main(config: LearnersConfig, _stop: Event) -> int:
    """Measure and print."""
    found = measure(config.ranks, config.envs, config.seconds, config.turns, config.seed)
    if config.json_line:
        print(json.dumps(found))
    else:
        print(
            f"{config.ranks} ranks train {found['frames_per_s']:,.0f} frames/s, {found['speedup']:.2f} times as many "
            f"as one; parameters differ by {found['parameters_difference']:.1e} after {EPOCHS_COMPARED} epochs"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("learners", LearnersConfig, main))
