"""Speed of the learner from memory, without actors and messages, and its share of bare matrix products.

    python -m benchmarks.learner --json

It trains epochs on rollouts that were played before. The limit are the matrix products of such an epoch alone: of the
network's layers, forward for reading the data, forward and backward for each gradient step, in the same precision and
batch size on the same thread, or on the same device. Both alternate. ``--device cuda`` also measures for which share of
the time the device computes.
"""

import json
import sys
from collections.abc import Callable
from itertools import cycle
from threading import Event

import numpy as np
import torch
from pydantic import Field
from torch import nn

from benchmarks.paired import paired, seconds_of
from benchmarks.play import make_player, make_training
from benchmarks.settings import TimedConfig, run
from common.comms.codec import encode
from common.policy.actor_critic import ActorCritic
from common.policy.network_pass import DTYPES
from services.learner.admission import open_rollout
from services.learner.compute import Compute
from services.learner.config import Device, PPOConfig

ROLLOUTS = 4  # played before the measurement, and repeated


def bare_products(
    network: ActorCritic, frames: int, ppo: PPOConfig, compute: Compute
) -> tuple[Callable[[], None], float]:
    """Return a function that computes an epoch's products, and how many floating-point operations they are."""
    dtype, rows = DTYPES[compute.precision], min(ppo.minibatch_of(frames), frames)
    batches = frames // rows
    layers, operations = [], 0.0
    for name, linear in network.named_modules():
        if not isinstance(linear, nn.Linear):
            continue
        inputs, outputs = linear.in_features, linear.out_features
        is_first = name == "trunk.layers.0"
        hidden = 0 if is_first else inputs - (network.obs_size if name.startswith("trunk.layers") else 0)
        x, w, g = (
            torch.randn(shape).to(compute.device, dtype)
            for shape in ((rows, inputs), (outputs, inputs), (rows, outputs))
        )
        layers.append((x, w, g, w[:, :hidden].contiguous()))
        steps = batches * ppo.mini_epochs
        operations += 2.0 * rows * outputs * (inputs * (batches + 2 * steps) + hidden * steps)

    def multiply() -> None:
        for _ in range(batches):
            for x, w, _, _ in layers:
                torch.mm(x, w.t())
        for _ in range(batches * ppo.mini_epochs):
            for x, w, g, back in layers:
                torch.mm(x, w.t())
                torch.mm(g.t(), x)
                if back.shape[1]:
                    torch.mm(g, back)
        if compute.device.type == "cuda":
            torch.cuda.synchronize()

    return multiply, operations


def busy_share(act: Callable[[], object]) -> float:
    """Return the share of the time of ``act`` in which the GPU computes or copies."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        seconds = seconds_of(act)
    busy_us = float(sum(event.self_device_time_total for event in profile.key_averages()))
    return busy_us / 1e6 / seconds


def measure(
    envs: int, seconds: float, seed: int, ppo: PPOConfig, device: Device = "cpu"
) -> dict[str, float | str]:
    """Train for ``seconds`` and return the figures."""
    training = make_training(ppo, seed, device=device)
    compute = training.compute
    player = make_player(training, envs, seed)
    rollouts = [player.play("benchmark", 1, sequence) for sequence in range(ROLLOUTS)]
    payload = encode(rollouts[0])
    following = cycle(rollouts)
    frames = rollouts[0].rewards.size
    products, operations = bare_products(training.network, frames, ppo, compute)

    def epoch() -> None:
        training.run_epoch([next(following)])  # it ends with the network's new parameters in the CPU's memory

    measured = paired(epoch, products, seconds)
    read_s, decode_s = (
        float(np.median([seconds_of(act) for _ in range(5)]))
        for act in (
            lambda: training.read([rollouts[0]]),
            lambda: open_rollout(payload, 2**30, training.obs_size),
        )
    )
    return {
        "frames_per_s": round(frames / measured.seconds, 1),
        "products_frames_per_s": round(frames / measured.limit, 1),
        "matmul_share": round(measured.share, 4),
        "products_gflops": round(operations / measured.limit / 1e9, 1),
        "epoch_ms": round(1e3 * measured.seconds, 1),
        "read_ms": round(1e3 * read_s, 1),
        "decode_ms": round(1e3 * decode_s, 2),
        "device": str(compute.device),
        "precision": compute.precision,
        "threads": torch.get_num_threads(),
        "frames": frames,
        "minibatch": ppo.minibatch_of(frames),
        "mini_epochs": ppo.mini_epochs,
        **({"busy_share": round(busy_share(epoch), 4)} if compute.device.type == "cuda" else {}),
    }


class LearnerBenchmarkConfig(TimedConfig):
    """Measure how fast the learner trains from memory, and compare it with its matrix products alone."""

    envs: int = Field(256, ge=1, le=65536, description="environments; a dataset has 32 frames of each")
    device: Device = Field("cpu", description="where updates compute; auto: on a GPU where there is one")
    ppo: PPOConfig = PPOConfig()


def main(config: LearnerBenchmarkConfig, _stop: Event) -> int:
    """Measure and print."""
    result = measure(config.envs, config.seconds, config.seed, config.ppo, config.device)
    if config.json_line:
        print(json.dumps(result))
    else:
        print(
            f"{result['frames_per_s']:,.0f} frames/s; products alone take {result['matmul_share']:.1%} of that time "
            f"({result['products_gflops']:.0f} GFLOP/s, {result['precision']}, {result['threads']} thread)"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run("learner", LearnerBenchmarkConfig, main))
