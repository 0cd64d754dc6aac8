"""Decoupled PPO: the update, as functions of a dataset, a network and an optimiser.

Hilton, Cobbe, Schulman 2022, "Batch size-invariance for policy optimization": data may come from a policy mu that
is a version or two old, so the trust region is kept around pi_prox (the policy before this update) and the
importance weight to mu is clipped from above:

    r = exp(log pi_theta - log pi_prox),  w = min(exp(log pi_prox - log mu), 2),  detached
    L = -mean(w min(r A, clip(r, 1 - eps, 1 + eps) A))

At lag 0 pi_prox = mu, w = 1: plain PPO.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from enum import Enum, auto
from typing import Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.policy.actor_critic import entropy
from common.policy.losses import Frames, LossWeights, Slopes, Sums, add_losses
from common.policy.network_pass import NetworkPass, Precision, native_precision
from common.policy.normalizer import Moments
from services.learner.config import PPOConfig
from services.learner.group import ALONE, Group

Array = npt.NDArray[np.float64]

MAX_WEIGHT = 2.0  # clip of pi_prox/mu
KL_STEP = 1.5  # factor of one learning-rate adjustment


def precision_of(config: PPOConfig) -> Precision:
    """Return the precision of the update's matrix products on this machine."""
    return native_precision() if config.precision == "auto" else config.precision


@dataclass(frozen=True, slots=True)
class Dataset:
    """One epoch's data, flattened, with everything that doesn't change during the update."""

    obs: Tensor  # (N, D) normalised
    actions: Tensor  # (N, A)
    log_mu: Tensor  # (N,) as recorded by the actor
    log_prox: Tensor  # (N,)
    mean_prox: Tensor  # (N, A)
    advantages: Tensor  # (N,) normalised
    value_targets: Tensor  # (N,) normalised
    corrections: Tensor  # (N, A) change of the mean action to aim at (or the teacher's); rows of zeros: none
    log_std_prox: Tensor  # (A,)

    def __len__(self) -> int:
        return len(self.obs)

    def taken(self, rows: Tensor) -> Self:
        """Return the frames of some rows, as copies."""
        return self._of(lambda column: torch.index_select(column, 0, rows))

    def between(self, start: int, end: int) -> Self:
        """Return the frames of a range of rows, as views."""
        return self._of(lambda column: column[start:end])

    def _of(self, part: Callable[[Tensor], Tensor]) -> Self:
        return replace(self, **{name: part(getattr(self, name)) for name in COLUMNS})

    def frames(self) -> Frames:
        """Return what the losses need of them."""
        return Frames(*(getattr(self, name).numpy() for name in Frames._fields))


COLUMNS: Final = tuple(field.name for field in fields(Dataset) if field.name != "log_std_prox")


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


class Share(NamedTuple):
    """Which frames of the group's dataset a rank has, and what it must know of the others'."""

    group: Group
    first: int  # index of its first frame
    frames: int  # of the whole dataset
    weight: float  # mean of pi_prox/mu before clipping, of the whole dataset
    has_corrections: bool  # whether any frame has one


def whole(data: Dataset) -> Share:
    """Return the share of a learner alone: all of its dataset."""
    weight = weight_sum(data.log_prox, data.log_mu) / len(data)
    return Share(ALONE, 0, len(data), weight, are_any(data.corrections))


def weight_sum(log_prox: Tensor, log_mu: Tensor) -> float:
    """Return the sum of pi_prox/mu over the frames, before clipping."""
    return float((log_prox - log_mu).exp().sum())


def are_any(corrections: Tensor) -> bool:
    """Return whether any frame has a correction."""
    return bool((corrections != 0.0).any())


def minibatches(
    data: Dataset, size: int, generator: torch.Generator, share: Share
) -> Iterator[tuple[Dataset, int]]:
    """Yield one pass over the group's dataset: its frames in random order, ``size`` at a time.

    Args:
        data: This rank's frames.
        size: Frames of a minibatch, over all ranks.
        generator: In the same state on every rank.
        share: Which frames of the whole dataset ``data`` are.

    Yields:
        This rank's frames of a minibatch, and how many the minibatch has over all ranks.
    """
    order = torch.randperm(share.frames, generator=generator)
    is_own = (order >= share.first) & (order < share.first + len(data))
    shuffled = data.taken(order[is_own] - share.first)
    at = 0
    for mine in torch.split(is_own, size):
        count = int(mine.sum())
        # a small remainder would weigh as much as a full batch
        if len(mine) >= min(size, share.frames) // 2:
            yield shuffled.between(at, at + count), len(mine)
        at += count


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


def kl_sum(batch: Dataset, moved: Array, log_std: Tensor) -> float:
    """Return the sum over a minibatch of KL(prox, new).

    Args:
        batch: Its frames.
        moved: Sum over the frames of the squared changes of the mean action (A,).
        log_std: Of the new policy (A,).
    """
    old, new = (values.double().numpy() for values in (batch.log_std_prox, log_std))
    spread = (len(batch) * np.exp(2.0 * old) + moved) / (2.0 * np.exp(2.0 * new))
    return float((len(batch) * (new - old - 0.5) + spread).sum())


def limit_norm(gradient: Tensor, longest: float) -> float:
    """Shorten a gradient that is longer than ``longest``, and return its length before."""
    norm = float(torch.linalg.vector_norm(gradient))
    gradient.mul_(min(longest / (norm + 1e-6), 1.0))  # as torch's clip_grad_norm_ does
    return norm


def update(
    network_pass: NetworkPass,
    optimizer: torch.optim.Optimizer,
    data: Dataset,
    config: PPOConfig,
    rate: LearningRate,
    generator: torch.Generator,
    explained: float = 0.0,
    on_tick: Callable[[], None] = lambda: None,
    mode: UpdateMode = UpdateMode.PPO,
    share: Share | None = None,
) -> UpdateStats:
    """Run the mini-epochs of one epoch. The network and ``optimizer`` are changed in place.

    Args:
        network_pass: Of policy and critic as they are now, for a minibatch or more.
        optimizer: Adam over their parameters.
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
    group = share.group
    log_std = network_pass.network.log_std.detach()
    learns = mode is not UpdateMode.CRITIC_ONLY
    learns_noise = mode is UpdateMode.PPO or (learns and config.entropy_weight > 0)
    gradient, noise_gradient = network_pass.gradient_of(learns, learns_noise)
    weights = LossWeights(
        clip=config.clip,
        value=config.value_weight,
        bound=config.bound_weight,
        correction=config.correction_weight if learns and share.has_corrections else 0.0,
        most_weight=MAX_WEIGHT,
        has_surrogate=mode is UpdateMode.PPO,
        # A teacher's correction is relative to the played action, a hit's to the mean action
        from_played=mode is UpdateMode.DISTILL,
    )
    shape = data.actions.shape
    slopes = Slopes(*(np.zeros(n, np.float32) for n in (shape, shape[:1], shape[1:])))
    moved = np.zeros(shape[1])
    losses, norms, steps = np.zeros(len(Sums._fields)), 0.0, 0
    learning_rate = rate.start
    finite, kl = True, 0.0
    for _ in range(config.mini_epochs):
        for settings in optimizer.param_groups:
            settings["lr"] = learning_rate
        # of this rank: sum of the KL divergences, and of the losses
        sums, batches = np.zeros(1 + len(losses)), 0
        for batch, count in minibatches(data, config.minibatch, generator, share):
            if len(batch):
                mean, values = network_pass.forward(batch.obs)
                found = add_losses(
                    *(mean.numpy(), values.numpy(), log_std.numpy(), batch.frames(), weights, count),
                    *slopes,
                    moved,
                )
                rows = slice(len(batch))
                network_pass.backward(
                    torch.from_numpy(slopes.mean[rows]) if learns else None,
                    torch.from_numpy(slopes.value[rows]),
                )
                if learns_noise:
                    noise_gradient.copy_(torch.from_numpy(slopes.log_std))
                    noise_gradient.sub_(config.entropy_weight * len(batch) / count)
            else:
                gradient.zero_()
            group.add(gradient.numpy())
            norm = limit_norm(gradient, config.gradient_norm)
            if not np.isfinite(norm):
                finite = False
                continue
            optimizer.step()
            network_pass.refresh()
            norms, batches = norms + norm, batches + 1
            if len(batch):
                sums += np.array([kl_sum(batch, moved, log_std), *found]) / count
            on_tick()
        group.add(sums)
        losses, steps = losses + sums[1:], steps + batches
        kl = float(sums[0]) / batches if batches else math.inf  # no step was finite: smaller ones are needed
        if mode is UpdateMode.PPO and config.schedule == "adaptive":
            learning_rate = adapted_learning_rate(
                learning_rate, kl, config.learning_rate_min, rate.highest, config.target_kl
            )
    means = Sums(*(losses / max(steps, 1)).tolist())
    return UpdateStats(
        policy_loss=means.policy,
        value_loss=means.value,
        bound_loss=means.bound,
        correction_loss=means.correction,
        entropy=float(entropy(log_std)),
        kl=kl,
        clip_fraction=means.outside,
        weight=share.weight,
        gradient_norm=norms / max(steps, 1),
        explained_variance=explained,
        learning_rate=learning_rate,
        finite=finite,
    )
