"""What all trainers have in common: the environment, the shape of network and batch, and how they leave their progress.

A trainer is a program ``python -m benchmarks.peers.launch.NAME FOLDER ...``. While it trains, it writes into the folder

- ``progress.csv``: lines ``seconds,frames``, with the wall time since its start was ordered;
- ``SECONDS-FRAMES.pt``: its deterministic policy, ``Normalized`` with our trunk and a linear layer.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor, nn

from common.env.robot import home_action
from common.policy.config import NetworkConfig
from common.policy.d2rl import D2RL
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import policy_layout, size
from topspin.gym_vector import RallyVectorEnv

TASK: Final = TaskConfig()
STAGE: Final = 1
ENVS: Final = 256
HORIZON: Final = 32  # control steps of a rollout
FRAMES: Final = ENVS * HORIZON  # of a dataset
PASSES: Final = 4
MINIBATCH: Final = 2048
OBS: Final = size(policy_layout(TASK.observation))
ACTIONS: Final = 7
LOG_STD: Final = NetworkConfig().initial_log_std
HOME: Final = torch.from_numpy(home_action(TASK.robot))
# Our learner's values where a trainer has such a setting
GAMMA, GAE_LAMBDA, CLIP, LEARNING_RATE, TARGET_KL, GRADIENT_NORM, REWARD_SCALE = (
    0.99,
    0.9,
    0.2,
    5e-4,
    0.01,
    1.0,
    0.1,
)
OBS_CLIP: Final = 5.0
CORES: Final = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
SNAPSHOT_S: Final = 10.0
PROGRESS: Final = "progress.csv"


@dataclass(frozen=True, slots=True)
class Order:
    """What a trainer is asked for."""

    folder: Path
    started: float  # [s] when it was ordered, by ``time.time``
    seconds: float  # how long it may train from then on
    seed: int
    threads: int  # of torch and MuJoCo in a process that does not share its work with others


def order() -> Order:
    """Return what the command line asks for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--started", type=float, default=time.time())
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=CORES)
    asked = Order(**vars(parser.parse_args()))
    asked.folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(asked.threads)
    torch.manual_seed(asked.seed)
    np.random.seed(asked.seed)  # trainers draw from it
    return asked


def make_envs(
    mode: AutoresetMode = AutoresetMode.SAME_STEP, threads: int = 0, count: int = ENVS
) -> RallyVectorEnv:
    """Return the environments: stage 1, our actors' episodes, and what our policy observes.

    Args:
        mode: When an ended episode begins again.
        threads: Of MuJoCo; 0: as many as torch has.
        count: How many.
    """
    experience = ExperienceConfig()
    return RallyVectorEnv(
        count,
        STAGE,
        threads=threads or torch.get_num_threads(),
        autoreset_mode=mode,
        observation=TASK.observation,
        end_at_hit_share=experience.end_at_hit_share,
        continue_share=experience.continue_share,
    )


def make_trunk() -> D2RL:
    """Return our network's hidden layers (N, D) -> (N, 32), initialised as ours are."""
    trunk = D2RL(OBS, NetworkConfig().units)
    for layer in trunk.layers:
        start_layer(layer, 2.0**0.5)
    return trunk


def make_heads(trunk: D2RL) -> tuple[nn.Linear, nn.Linear, nn.Parameter]:
    """Return mean action (N, 32) -> (N, 7), value (N, 32) -> (N, 1) and log standard deviation (7,), as ours start."""
    mean, value = (nn.Linear(trunk.out_features, outputs) for outputs in (ACTIONS, 1))
    start_layer(mean, 0.01, HOME)
    start_layer(value, 1.0)
    return mean, value, nn.Parameter(torch.full((ACTIONS,), LOG_STD))


def start_layer(layer: nn.Module, gain: float, bias: Tensor | None = None) -> None:
    """Initialise a linear layer: orthogonal weights, and a bias of 0 unless it is given."""
    if not isinstance(layer, nn.Linear):
        raise TypeError(f"{type(layer).__name__}; allowed: Linear")
    nn.init.orthogonal_(layer.weight, gain)
    with torch.no_grad():
        layer.bias.copy_(torch.zeros_like(layer.bias) if bias is None else bias)


class Recorder:
    """Writes a trainer's progress and its policies.

    Args:
        asked: What it is asked for.
    """

    def __init__(self, asked: Order) -> None:
        self._asked = asked
        self._next_snapshot = SNAPSHOT_S
        self._progress = asked.folder / PROGRESS
        self._progress.write_text("")

    def note(self, frames: int, policy: Callable[[], "Normalized | None"]) -> bool:
        """Note the frames so far, after an update, and keep the policy when it is time; return whether time is up.

        Args:
            frames: So far.
            policy: Returns the deterministic policy, with our trunk and a linear layer; None: it is not at hand yet.
        """
        seconds = time.time() - self._asked.started
        with self._progress.open("a", encoding="utf-8") as file:
            file.write(f"{seconds:.3f},{frames}\n")
        is_over = seconds >= self._asked.seconds
        found = policy() if seconds >= self._next_snapshot or is_over else None
        if found is not None:
            self._next_snapshot = seconds + SNAPSHOT_S
            save(found, self._asked.folder / f"{seconds:.1f}-{frames}.pt")
        return is_over


class Normalized(nn.Module):
    """A policy behind a normaliser: clip((observation - mean) / scale) goes in.

    Args:
        mean: (D,).
        scale: (D,) that deviations are divided by.
        clip: Largest absolute value.
        policy: Normalised observations in, actions out.
    """

    def __init__(self, mean: Tensor, scale: Tensor, clip: float, policy: nn.Module) -> None:
        super().__init__()
        self.mean, self.scale, self.clip = mean.float(), scale.float(), clip
        self.policy = policy

    def forward(self, obs: Tensor) -> Tensor:
        """Return actions (B, 7) for observations (B, D)."""
        actions: Tensor = self.policy(torch.clamp((obs - self.mean) / self.scale, -self.clip, self.clip))
        return actions


def save(policy: Normalized, file: Path) -> None:
    """Write a policy; a reader never sees a part of it."""
    part = file.with_suffix(".part")
    moments = {"mean": policy.mean, "scale": policy.scale, "clip": policy.clip}
    torch.save({**moments, "layers": policy.policy.state_dict()}, part)
    part.rename(file)


def load(file: Path) -> Normalized:
    """Return a policy that ``save`` wrote."""
    found = torch.load(file, weights_only=True)
    trunk = make_trunk()
    layers = nn.Sequential(trunk, nn.Linear(trunk.out_features, ACTIONS))
    layers.load_state_dict(found["layers"])
    return Normalized(found["mean"], found["scale"], found["clip"], layers)
