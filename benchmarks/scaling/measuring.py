"""Measuring the costs on this machine: a few seconds for each part.

Times are CPU times of this process, so that other work on the machine counts less. A quiet machine still gives better
figures: other work takes cache, and exchanges between processes are timed by the clock.
"""

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from benchmarks import generator, startup
from benchmarks.actor import playing
from benchmarks.paired import seconds_of
from benchmarks.play import HORIZON, STAGE, make_player, make_training
from benchmarks.scale.sizes import policy_snapshot
from benchmarks.scaling import messages
from benchmarks.scaling.costs import Costs, Line, exchange_line
from common.comms.codec import decode, encode
from common.comms.messages import PolicySnapshot, Rollout
from common.errors import ReportedError
from common.evaluation.evaluate import check
from common.evaluation.match import evaluation_rallies, play_match
from common.policy.contract import contract_of
from common.policy.folder import Policy
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from deploy.prepare import free_port
from services.evaluator.config import EvaluatorOptions
from services.generator.config import GeneratorOptions
from services.learner.admission import open_rollout
from services.learner.config import PPOConfig
from services.learner.group import Group, join
from services.learner.training import Training

ENVS: Final = (4, 16, 64, 256)  # of the measured actors
FEW, MANY = ENVS[0], ENVS[-1]
SPREAD_STEPS: Final = (
    128  # control steps before the measurement, in which the rallies come into all their phases
)
PIECES: Final = 16  # small rollouts that are read together
SMALL_MINIBATCH: Final = 256
ECHOES: Final = 64  # ranks of a group that is only pretended
LIMIT_BYTES: Final = 2**30
SUMS: Final = 200  # of each size
RALLIES: Final = 250  # of the measured match
READY_S: Final = 120.0
START: Final = """
from benchmarks.play import make_player, make_training
from services.learner.config import PPOConfig
make_player(make_training(PPOConfig(), 0), 256, 0).play("start", 1, 0)
"""


@dataclass(frozen=True, slots=True)
class Echo(Group):
    """A rank whose other ranks say what it says: what a rank computes in a large group, without the exchanges."""

    def add(self, values: npt.NDArray[Any]) -> None:
        """Leave this rank's part of the sum."""

    def gathered(
        self, *arrays: npt.NDArray[Any], on_tick: Callable[[], None] | None = None
    ) -> list[list[npt.NDArray[Any]]]:
        """Return this rank's arrays as everyone's."""
        del on_tick
        return [list(arrays)] * self.size


def cpu_of(act: Callable[[], object], seconds: float) -> float:
    """Return the median CPU time of a call [s]; three calls or as many as fit into ``seconds``, after one more."""
    act()
    taken: list[float] = []
    started = time.perf_counter()
    while len(taken) < 3 or time.perf_counter() - started < seconds:
        before = time.process_time()
        act()
        taken.append(time.process_time() - before)
    return statistics.median(taken)


def machine_name(cores: int) -> str:
    """Return the processor's name, and how many cores of it there are."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.is_file() else []
    name = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown"
    )
    return f"{name}, {cores} cores"


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def measure(seconds: float, seed: int, stop: Event) -> Costs:
    """Return the costs of this machine.

    Args:
        seconds: Of each part's measurement; there are about a dozen.
        seed: Of all random numbers.
        stop: Ends the measurement.
    """
    training = make_training(PPOConfig(), seed)
    players = {envs: make_player(training, envs, seed) for envs in ENVS}
    play_s, rollouts = {}, {}
    for envs, player in players.items():
        check(stop)
        play = playing(player)
        for _ in range(SPREAD_STEPS // HORIZON):
            rollouts[envs] = play()
        play_s[envs] = cpu_of(partial(_played, play), seconds)
    few, many = rollouts[FEW], rollouts[MANY]
    slowdown = _slowdown(playing(players[MANY]), play_s[MANY], seconds, seed)
    snapshot = encode(policy_snapshot(training))
    check(stop)
    adopt_s = cpu_of(lambda: players[FEW].adopt(decode(snapshot, PolicySnapshot)), seconds / 4)
    found = _learner(training, few, many, seconds, seed)
    check(stop)
    sizes = (len(encode(few)), len(encode(many)))
    found |= messages.measure(sizes, len(snapshot), seconds)
    check(stop)
    gradient = 4 * sum(parameter.numel() for parameter in training.network.parameters())
    return Costs(
        machine=machine_name(usable_cores()),
        play_s=play_s,
        adopt_s=adopt_s,
        publish_s=cpu_of(lambda: encode(policy_snapshot(training)), seconds / 4),
        exchange=exchange_line([(4.0 * n, taken) for n, taken in _sums_s((2, gradient // 4)).items()]),
        rollout=Line.through((few.rewards.size, sizes[0]), (many.rewards.size, sizes[1])),
        policy_bytes=len(snapshot),
        gradient_bytes=gradient,
        generator_share=_generator_share(seconds / 2, seed),
        evaluator_share=_evaluator_share(training),
        slowdown=slowdown,
        start_s=startup.seconds_of(("-c", START))[1],
        **found,
    )


def _played(play: Callable[[], Rollout]) -> bytes:
    return encode(play())


def _learner(training: Training, few: Rollout, many: Rollout, seconds: float, seed: int) -> dict[str, Any]:
    """Return the learner's costs; ``few`` and ``many`` are rollouts of few and of many environments."""
    opening, reading = [], []
    for rollout, pieces in ((few, PIECES), (many, 1)):
        frames = rollout.rewards.size
        opened = partial(open_rollout, encode(rollout), LIMIT_BYTES, training.obs_size)
        opening.append((frames, cpu_of(opened, seconds / 4)))
        reading.append((frames, cpu_of(partial(training.read, [rollout] * pieces), seconds / 2) / pieces))
    ppo, frames = training.ppo, many.rewards.size
    own_size = ppo.minibatch_of(frames)
    steps = []
    for minibatch in (SMALL_MINIBATCH, own_size):
        own = make_training(ppo.model_copy(update={"minibatch": minibatch}), seed)
        epoch_s = cpu_of(partial(own.run_epoch, [many]), seconds)
        update_s = epoch_s - cpu_of(partial(own.read, [many]), seconds / 2)
        steps.append((minibatch, update_s * minibatch / (ppo.mini_epochs * frames)))
    echo = make_training(ppo.model_copy(update={"minibatch": ECHOES * own_size}), seed, Echo(0, ECHOES))
    whole_s = cpu_of(partial(echo.run_epoch, [many]), seconds) - epoch_s
    return {
        "opening": Line.through(*opening),
        "reading": Line.through(*reading),
        "step": Line.through(*steps),
        "whole_frame_s": max(0.0, whole_s / ((ECHOES - 1) * frames)),
    }


# ---- all cores busy


def _slowdown(play: Callable[[], Rollout], alone_s: float, seconds: float, seed: int) -> float:
    """Return the CPU time of a rollout while every other core trains, over that alone."""
    context = multiprocessing.get_context("spawn")
    pipes, others = [], []
    for _ in range(usable_cores() - 1):
        ours, theirs = context.Pipe()
        other = context.Process(target=_train_until_told, args=(theirs, seed), daemon=True)
        other.start()
        theirs.close()
        pipes.append(ours)
        others.append(other)
    try:
        for pipe in pipes:
            if not pipe.poll(READY_S):
                raise ReportedError(f"a process that trains is not ready in {READY_S:.0f} s")
        together = cpu_of(partial(_played, play), seconds)
    finally:
        for pipe, other in zip(pipes, others, strict=True):
            pipe.close()
            other.join(10.0)
            other.kill()
    return max(1.0, together / alone_s)


def _train_until_told(pipe: Connection, seed: int) -> None:
    """Train until the other end of the pipe is closed."""
    training = make_training(PPOConfig(), seed)
    rollouts = [make_player(training, MANY, seed).play("benchmark", 1, 0)]
    training.run_epoch(rollouts)
    pipe.send(True)
    while not pipe.poll():
        training.run_epoch(rollouts)


# ---- sums of a group


def _sums_s(sizes: tuple[int, ...]) -> dict[int, float]:
    """Return the median time of a sum over two ranks [s], by how many float32 are summed."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    port = free_port()
    ranks = [context.Process(target=_add, args=(rank, port, sizes, sender)) for rank in range(2)]
    for rank in ranks:
        rank.start()
    try:
        if not receiver.poll(READY_S):
            raise ReportedError(f"two ranks gave no sums in {READY_S:.0f} s")
        return dict(receiver.recv())
    finally:
        for rank in ranks:
            rank.join(10.0)
            rank.kill()


def _add(rank: int, port: int, sizes: tuple[int, ...], result: Connection) -> None:
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"}
    torch.set_num_threads(1)
    group = join({"RANK": str(rank), "WORLD_SIZE": "2"})
    found = {}
    for size in sizes:
        values = np.zeros(size, np.float32)
        group.add(values)
        found[size] = statistics.median(seconds_of(partial(group.add, values)) for _ in range(SUMS))
    if rank == 0:
        result.send(found)
    group.leave()


# ---- what runs beside them


def _generator_share(seconds: float, seed: int) -> float:
    """Return the share of a core that publishes the rallies of one actor."""
    options, task = GeneratorOptions(), TaskConfig()
    generator.measure(
        task.launch, task.randomization, task.flight, options.batch, seed, 0.1
    )  # loads the kernels
    before = time.process_time()
    made = generator.measure(task.launch, task.randomization, task.flight, options.batch, seed, seconds)
    return options.rate_hz * (time.process_time() - before) / made.rallies


def _evaluator_share(training: Training) -> float:
    """Return the share of a core that the evaluator uses: it plays a match, waits, and plays the next one."""
    options, task = EvaluatorOptions(), TaskConfig()
    where = {"generation": 1, "version": 0, "stage": STAGE, "frames": 0}
    contract = contract_of(task, ExperienceConfig(), training.network_config, run="benchmark", **where)
    policy = Policy(training.network, training.obs_moments, contract)
    rallies = evaluation_rallies(RALLIES, task, 0)
    before = time.process_time()
    play_match(policy, rallies, task, options.envs)
    match_s = (time.process_time() - before) * options.rallies / RALLIES
    return match_s / (match_s + options.interval_s)
