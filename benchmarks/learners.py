"""Speed of a group of learners against one, from memory, and how far their parameters are apart.

    python -m benchmarks.learners --json

The same rollouts, played before, are trained by one learner and by a group of ranks, each with its share of them, in
turns. A rank has the frames that one learner trains by default, in minibatches that are as many times as large as there
are ranks. The limit is a learner that trains a rank's part alone, times the ranks: nothing is exchanged there.

The group's parameters after three epochs, in float32, are compared with those of one learner, twice. By default PPO's
clip makes the gradient discontinuous: a frame whose probability ratio is within a rounding error of the clip counts in
one sum and not in the other, and from then on they drift apart. This happens in some trainings and not in others. One
learner that adds its frames in the reverse order drifts in the same way (ADR-0062). With a clip of ``WIDE`` no frame is
near it, and what is left is rounding: some 1e-7.
"""

import json
import multiprocessing
import os
import sys
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from benchmarks.play import HORIZON, make_player, make_training
from benchmarks.settings import TimedConfig, run
from common.comms.codec import decode, encode
from common.comms.messages import Rollout
from deploy.prepare import free_port
from services.learner.compute import compute_of
from services.learner.config import PPOConfig
from services.learner.group import join

EPOCHS_COMPARED: Final = 3
WIDE: Final = 0.99  # clip of the second comparison
WARM_UP: Final = 3  # epochs before the measurement
LONGEST_START_S: Final = 300.0

Floats = npt.NDArray[np.float32]
Links = Literal["memory", "torch"]


def _rank(
    rank: int,
    size: int,
    where: Mapping[str, str],
    payloads: list[bytes],
    ppo: PPOConfig,
    seconds: float,
    results: Connection,
) -> None:
    """Train as one rank, and send frames/s of the group (0: not measured) and the parameters."""
    os.environ |= where  # torch reads its part from there
    group = join({"RANK": str(rank), "WORLD_SIZE": str(size), **where})
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


def train(
    size: int, payloads: list[bytes], ppo: PPOConfig, seconds: float, links: Links = "memory"
) -> tuple[float, Floats]:
    """Return frames/s of a group of ``size`` ranks, and the parameters of the first after the warm-up and that time.

    Args:
        size: Ranks, each a process.
        payloads: Encoded rollouts, whose number ``size`` divides.
        ppo: Hyper-parameters.
        seconds: To measure; 0: train ``EPOCHS_COMPARED`` epochs.
        links: Between the ranks: as `topspin train --learners` has them, or as torchrun.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    other, unused = context.Pipe(duplex=False)
    with TemporaryDirectory(prefix="topspin-") as folder:
        where = (
            {"GROUP_FILE": str(Path(folder) / "group")}
            if links == "memory"
            else {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
        )
        ranks = [
            context.Process(
                target=_rank, args=(rank, size, where, payloads, ppo, seconds, unused if rank else sender)
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


def measure(
    ranks: int, envs: int, seconds: float, turns: int, seed: int, links: Links
) -> dict[str, float | int | str]:
    """Return the figures of a group of ``ranks``."""
    part = PPOConfig().minibatch_of(HORIZON * envs)
    own = PPOConfig(minibatch=part)  # of a learner that trains a rank's part alone
    ppo = PPOConfig(minibatch=ranks * part)
    player = make_player(make_training(ppo, seed), envs, seed)
    payloads = [encode(player.play("benchmark", 1, sequence)) for sequence in range(ranks)]

    def difference(clip: float) -> float:
        exact = ppo.model_copy(update={"precision": "float32", "clip": clip})
        alone, together = (train(size, payloads, exact, 0.0, links)[1] for size in (1, ranks))
        return float(np.abs(alone - together).max())

    each = seconds / turns
    speeds = np.array(
        [
            [
                train(1, payloads, ppo, each)[0],
                train(ranks, payloads, ppo, each, links)[0],
                ranks * train(1, payloads[:1], own, each)[0],
            ]
            for _ in range(turns)
        ]
    )
    one, group, limit = np.median(speeds, axis=0)
    return {
        "ranks": ranks,
        "links": links,
        "speedup": round(float(np.median(speeds[:, 1] / speeds[:, 0])), 3),
        "share_of_limit": round(float(np.median(speeds[:, 1] / speeds[:, 2])), 3),
        "frames_per_s": round(float(group), 1),
        "frames_per_s_alone": round(float(one), 1),
        "frames_per_s_limit": round(float(limit), 1),
        "parameters_difference": difference(ppo.clip),
        "parameters_difference_wide_clip": difference(WIDE),
        "epochs_compared": EPOCHS_COMPARED,
        "frames": HORIZON * envs * ranks,
        "minibatch": ppo.minibatch,
        "precision": compute_of(ppo).precision,
    }


class LearnersConfig(TimedConfig):
    """Measure how much faster a group of learners trains than one, and compare their parameters."""

    ranks: int = Field(2, ge=2, le=64, description="learners of the group, each a process with a core")
    envs: int = Field(
        256, ge=1, le=65536, description="environments of each rank; a dataset has 32 frames of each"
    )
    turns: int = Field(3, ge=1, le=100, description="measurements of each, alternating")
    links: Links = Field(
        "memory",
        description="between the ranks: memory: as topspin train --learners has them; torch: as torchrun",
    )


def main(config: LearnersConfig, _stop: Event) -> int:
    """Measure and print."""
    found = measure(config.ranks, config.envs, config.seconds, config.turns, config.seed, config.links)
    if config.json_line:
        print(json.dumps(found))
    else:
        print(
            f"{config.ranks} ranks train {found['frames_per_s']:,.0f} frames/s, {found['speedup']:.2f} times as many "
            f"as one, {found['share_of_limit']:.0%} of {config.ranks} that do not talk; parameters differ by "
            f"{found['parameters_difference_wide_clip']:.1e} after {EPOCHS_COMPARED} epochs, and by "
            f"{found['parameters_difference']:.1e} where frames are clipped"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("learners", LearnersConfig, main))
