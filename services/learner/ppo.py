"""Decoupled PPO: the update, as functions of a dataset and an engine.

Hilton, Cobbe, Schulman 2022, "Batch size-invariance for policy optimization": data may come from a policy mu that
is a version or two old, so the trust region is kept around pi_prox (the policy before this update) and the
importance weight to mu is clipped from above:

    r = exp(log pi_theta - log pi_prox),  w = min(exp(log pi_prox - log mu), 2),  detached
    L = -mean(w min(r A, clip(r, 1 - eps, 1 + eps) A))

At lag 0 pi_prox = mu, w = 1: plain PPO.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.policy.actor_critic import entropy
from common.policy.losses import LossWeights
from common.policy.normalizer import Moments
from services.learner.config import PPOConfig
from services.learner.engine import OF_FRAMES, Engine, Plan, StepSums
from services.learner.minibatches import Dataset, Share, minibatches, whole

MAX_WEIGHT = 2.0  # clip of pi_prox/mu
KL_STEP = 1.5  # factor of one learning-rate adjustment


class UpdateMode(Enum):
    """What the policy learns from in an update. The critic learns the rewards in each."""

    PPO = auto()
    # The first epochs of a stage: the critic does not know the stage's rewards yet. With the old values it would punish
    # the contact that the new rewards need.
    CRITIC_ONLY = auto()
    # The teacher's corrections, without a trust region: that is for advantages that are estimated from noisy returns.
    # With it the KL divergence held the learning rate at 2e-5.
    DISTILL = auto()


class LearningRate(NamedTuple):
    """The learning rate of one update."""

    start: float  # adapted after every pass
    highest: float  # upper bound in this epoch


@dataclass(frozen=True, slots=True)
class UpdateStats:
    """The result of an update."""

    policy_loss: float
    value_loss: float
    bound_loss: float
    correction_loss: float
    entropy: float
    kl: float  # KL(prox, new), mean over the last pass: the learning rate adapts to it
    clip_fraction: float
    weight: float  # mean of pi_prox/mu before clipping: 1 at lag 0
    gradient_norm: float  # before clipping
    explained_variance: float
    learning_rate: float
    finite: bool  # False: a gradient step was skipped because it was not finite


def adapted_learning_rate(rate: float, kl: float, low: float, high: float, target: float) -> float:
    """Return the learning rate adapted to the KL divergence of the last pass, within [low, high]."""
    if kl > 2.0 * target:
        rate /= KL_STEP
    elif kl < 0.5 * target:
        rate *= KL_STEP
    return min(max(rate, low), high)


def explained_variance(targets: npt.NDArray[np.float32], values: npt.NDArray[np.float32]) -> float:
    """Return 1 - Var(target - value) / Var(target): 1 is perfect, 0 no better than the mean."""
    variance = float(np.var(targets))
    return 1.0 - float(np.var(targets - values)) / variance if variance > 0 else 0.0


def denormalized(values: Tensor, moments: Moments) -> npt.NDArray[np.float32]:
    """Return values in reward units (float32) from the critic's normalised ones."""
    scale, mean = np.float32(np.sqrt(moments.var + 1e-5)), np.float32(moments.mean)
    result: npt.NDArray[np.float32] = values.numpy() * scale + mean
    return result


def update(
    engine: Engine,
    data: Dataset,
    config: PPOConfig,
    rate: LearningRate,
    generator: torch.Generator,
    explained: float = 0.0,
    on_tick: Callable[[], None] = lambda: None,
    mode: UpdateMode = UpdateMode.PPO,
    share: Share | None = None,
) -> UpdateStats:
    """Run the mini-epochs of one epoch. The engine's network and optimiser are changed in place.

    Args:
        engine: Of policy and critic as they are now, for minibatches of ``config`` or more.
        data: This epoch's dataset.
        config: Hyper-parameters.
        rate: Learning rate at the start, and its upper bound.
        generator: Shuffles the minibatches.
        explained: Explained variance of the values in the dataset; it is copied to the result.
        on_tick: Called between gradient steps.
        mode: What the policy learns from.
        share: Which frames of the group's dataset ``data`` are; None: all of them.
    """
    share = share or whole(data)
    size = config.minibatch_of(share.frames)
    data = engine.begin(data, _plan(config, mode, share))
    learning_rate = rate.start
    passes = []  # sums of each
    finite = True
    for _ in range(config.mini_epochs):
        for settings in engine.optimizer.param_groups:
            settings["lr"] = learning_rate
        rows = []
        for batch, count in minibatches(data, size, generator, share):
            rows.append(engine.step(batch, count))
            on_tick()
        sums = engine.sums(rows)
        share.group.add(sums[:OF_FRAMES])
        done = StepSums(*sums.tolist())
        passes.append(done)
        finite = finite and done.steps == len(rows)
        if mode is UpdateMode.PPO and config.schedule == "adaptive":
            learning_rate = adapted_learning_rate(
                learning_rate, _kl(done), config.learning_rate_min, rate.highest, config.target_kl
            )
    engine.end()
    together = np.sum(passes, axis=0)
    means = StepSums(*(together / max(together[-1], 1.0)).tolist())
    return UpdateStats(
        policy_loss=means.policy,
        value_loss=means.value,
        bound_loss=means.bound,
        correction_loss=means.correction,
        entropy=float(entropy(engine.network.log_std.detach())),
        kl=_kl(passes[-1]),
        clip_fraction=means.outside,
        weight=share.weight,
        gradient_norm=means.norm,
        explained_variance=explained,
        learning_rate=learning_rate,
        finite=finite,
    )


def _plan(config: PPOConfig, mode: UpdateMode, share: Share) -> Plan:
    """Return what the steps of an update have in common."""
    learns = mode is not UpdateMode.CRITIC_ONLY
    weights = LossWeights(
        clip=config.clip,
        value=config.value_weight,
        bound=config.bound_weight,
        correction=config.correction_weight if learns and share.has_corrections else 0.0,
        most_weight=MAX_WEIGHT,
        has_surrogate=mode is UpdateMode.PPO,
        # A teacher's correction is relative to the played action, the way home to the mean action
        from_played=mode is UpdateMode.DISTILL,
    )
    return Plan(
        weights=weights,
        learns_policy=learns,
        learns_noise=mode is UpdateMode.PPO or (learns and config.entropy_weight > 0),
        entropy_weight=config.entropy_weight,
        gradient_norm=config.gradient_norm,
        group=share.group,
    )


def _kl(done: StepSums) -> float:
    """Return the mean KL divergence of a pass's steps; infinite if none was finite: smaller steps are needed."""
    return done.kl / done.steps if done.steps else math.inf
