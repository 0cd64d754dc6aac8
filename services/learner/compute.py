"""What the learner computes with: device, precision and threads, decided in one place."""

import os
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import torch

from common.errors import ReportedError
from common.policy.actor_critic import ActorCritic
from common.policy.network_pass import Precision, native_precision
from services.learner.accelerator import DeviceEngine
from services.learner.config import Device, PPOConfig
from services.learner.engine import CpuEngine, Engine


class Compute(NamedTuple):
    """What an update computes with."""

    device: torch.device
    precision: Precision  # of matrix products; weights, losses and Adam are float32
    threads: int  # of the CPU


def compute_of(
    ppo: PPOConfig, device: Device = "cpu", environment: Mapping[str, str] = os.environ
) -> Compute:
    """Return what the settings mean on this machine.

    Args:
        ppo: Precision and threads.
        device: cuda is the GPU of this rank: the first rank of a machine has its first GPU.
        environment: The process's.

    Raises:
        ReportedError: It has no such device.
    """
    has_cuda = torch.cuda.is_available()
    if device == "cuda" and not has_cuda:
        raise ReportedError(
            f"device cuda, but PyTorch {torch.__version__} finds none here; allowed: cpu, auto"
        )
    if device == "cpu" or not has_cuda:
        found, native = torch.device("cpu"), native_precision()
    else:
        rank, gpus = (
            int(environment.get("LOCAL_RANK", environment.get("RANK", "0"))),
            torch.cuda.device_count(),
        )
        ranks = int(environment.get("LOCAL_WORLD_SIZE", "1"))
        if ranks > gpus:  # NCCL refuses two ranks of one GPU
            raise ReportedError(f"device cuda with {ranks} learners and {gpus} GPUs; allowed: up to one each")
        found = torch.device("cuda", rank % gpus)
        with torch.cuda.device(found):
            is_native = torch.cuda.is_bf16_supported(including_emulation=False)
        native = "bfloat16" if is_native else "float32"
    return Compute(found, native if ppo.precision == "auto" else ppo.precision, ppo.threads)


def new_engine(network: ActorCritic, ppo: PPOConfig, compute: Compute) -> Engine:
    """Return the engine of a network, with a new optimiser."""
    make_optimizer = partial(torch.optim.Adam, lr=ppo.learning_rate, eps=1e-8, fused=True)
    if compute.device.type == "cpu":
        return CpuEngine(network, make_optimizer, ppo.largest_minibatch, compute.precision)
    return DeviceEngine(network, make_optimizer, compute.device, compute.precision)
