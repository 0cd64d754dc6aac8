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
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.policy.actor_critic import entropy, kl_divergence, log_prob
from common.policy.network_pass import NetworkPass, Precision, native_precision
from common.policy.normalizer import Moments
from services.learner.config import PPOConfig
from services.learner.group import ALONE, Group

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

    def taken(self, rows: Tensor | slice) -> Self:
        """Return some frames; of a slice they are views."""
        columns = {field.name: getattr(self, field.name)[rows] for field in fields(self)[:-1]}
        return replace(self, **columns)


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


def policy_loss(log_new: Tensor, log_prox: Tensor, log_mu: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """Return decoupled PPO's clipped surrogate loss (a scalar)."""
    ratio = torch.exp(log_new - log_prox)
    weight = torch.exp(log_prox - log_mu).clamp(max=MAX_WEIGHT).detach()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    return -(weight * torch.minimum(ratio * advantages, clipped * advantages)).mean()


def correction_loss(mean: Tensor, acted: Tensor, corrections: Tensor) -> Tensor:
    """Return half the mean squared distance of the mean actions from the corrected ones, where there are any.

    The corrected action is acted + correction. A hit correction is added to the mean at the start of this update,
    without the noise.

    Args:
        mean: (N, A).
        acted: (N, A).
        corrections: (N, A); a row of zeros is no correction. A zero in any other row leaves that action as it was (an
            action that was clipped, a drive at its limit).
    """
    is_corrected = (corrections != 0.0).any(-1, keepdim=True)
    return 0.5 * ((mean - acted - corrections).square() * is_corrected).sum(-1).mean()


class Share(NamedTuple):
    """Which frames of the group's dataset a rank has."""

    group: Group
    first: int  # index of its first frame
    frames: int  # of the whole dataset


def whole(data: Dataset) -> Share:
    """Return the share of a learner alone: all of its dataset."""
    return Share(ALONE, 0, len(data))


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
            yield shuffled.taken(slice(at, at + count)), len(mine)
        at += count


def sum_gradients(parameters: list[torch.nn.Parameter], group: Group) -> None:
    """Replace the parameters' gradients by their sums over the ranks: one message for all of them."""
    if group.size == 1:
        return
    learning = [parameter for parameter in parameters if parameter.requires_grad]
    for parameter in learning:
        if parameter.grad is None:  # the minibatch has no frame of this rank
            parameter.grad = torch.zeros_like(parameter)
    gradients = [parameter.grad for parameter in learning if parameter.grad is not None]
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    group.add(flat)
    parts = torch.split(flat, [gradient.numel() for gradient in gradients])
    torch._foreach_copy_(gradients, [p.view_as(g) for p, g in zip(parts, gradients, strict=True)])


def bound_loss(mean: Tensor) -> Tensor:
    """Return the mean squared excess of mean actions beyond +-1: targets that no joint can reach."""
    return (mean.abs() - 1.0).clamp(min=0.0).square().sum(-1).mean()


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


@dataclass(frozen=True, slots=True)
class _Losses:
    """Losses of one minibatch."""

    policy: Tensor
    value: Tensor
    bound: Tensor
    correction: Tensor
    total: Tensor
    log_new: Tensor  # (n,)


def _losses(
    mean: Tensor,
    values: Tensor,
    log_std: Tensor,
    batch: Dataset,
    config: PPOConfig,
    mode: UpdateMode,
    is_corrected: bool,
) -> _Losses:
    """Return the losses of one minibatch, given the network's outputs (n, A) and (n,)."""
    log_new = log_prob(batch.actions, mean, log_std)
    loss_policy = torch.zeros(())
    if mode is UpdateMode.PPO:
        loss_policy = policy_loss(log_new, batch.log_prox, batch.log_mu, batch.advantages, config.clip)
    loss_value = 0.5 * (values - batch.value_targets).square().mean()
    loss_bound = bound_loss(mean)
    loss = loss_policy + config.value_weight * loss_value + config.bound_weight * loss_bound
    loss_correction = torch.zeros(())
    if is_corrected:
        # A teacher's correction is relative to the played action, a hit's to the mean action
        acted = batch.actions if mode is UpdateMode.DISTILL else batch.mean_prox
        loss_correction = correction_loss(mean, acted, batch.corrections)
        loss = loss + config.correction_weight * loss_correction
    if config.entropy_weight > 0:
        loss = loss - config.entropy_weight * entropy(log_std)
    return _Losses(loss_policy, loss_value, loss_bound, loss_correction, loss, log_new)


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
    network = network_pass.network
    parameters = list(network.parameters())
    learns = mode is not UpdateMode.CRITIC_ONLY
    for parameter in network.policy_parameters():
        parameter.requires_grad_(learns)  # a frozen one has no gradient, so that Adam does not change it
    # Of this rank, until they are summed: sums over gradient steps, and log_prox - log_mu over frames
    sums = np.zeros(6)
    about = torch.tensor([(data.log_prox - data.log_mu).exp().sum(), (data.corrections != 0.0).any()])
    group.add(about)
    is_corrected = config.correction_weight > 0 and learns and bool(about[1])
    learning_rate = rate.start
    steps, finite, kl = 0, True, 0.0
    for _ in range(config.mini_epochs):
        for settings in optimizer.param_groups:
            settings["lr"] = learning_rate
        kl_sum, batches = 0.0, 0
        for batch, count in minibatches(data, config.minibatch, generator, share):
            part = len(batch) / count  # 1 for a learner alone: losses are means over a rank's frames
            optimizer.zero_grad(set_to_none=True)
            if part:
                mean, values = network_pass.forward(batch.obs)
                mean.requires_grad_(learns)
                values.requires_grad_()
                losses = _losses(mean, values, network.log_std, batch, config, mode, is_corrected)
                (part * losses.total).backward()  # type: ignore[no-untyped-call]
                network_pass.backward(mean.grad, values.grad)
            sum_gradients(parameters, group)
            norm = float(torch.nn.utils.clip_grad_norm_(parameters, config.gradient_norm, foreach=True))
            if not np.isfinite(norm):
                finite = False
                continue
            optimizer.step()
            network_pass.refresh()
            steps, batches = steps + 1, batches + 1
            if part:
                with torch.no_grad():
                    moved = kl_divergence(batch.mean_prox, batch.log_std_prox, mean, network.log_std)
                    outside = ((losses.log_new - batch.log_prox).exp() - 1.0).abs() > config.clip
                kl_sum += part * float(moved)
                sums += part * np.array(
                    (
                        losses.policy.item(),
                        losses.value.item(),
                        losses.bound.item(),
                        outside.float().mean().item(),
                        norm,
                        losses.correction.item(),
                    )
                )
            on_tick()
        total = torch.tensor([kl_sum], dtype=torch.float64)
        group.add(total)
        kl = float(total[0]) / batches if batches else math.inf  # no step was finite: smaller ones are needed
        if mode is UpdateMode.PPO and config.schedule == "adaptive":
            learning_rate = adapted_learning_rate(
                learning_rate, kl, config.learning_rate_min, rate.highest, config.target_kl
            )
    group.add(torch.from_numpy(sums))
    means = sums / max(steps, 1)
    return UpdateStats(
        policy_loss=float(means[0]),
        value_loss=float(means[1]),
        bound_loss=float(means[2]),
        correction_loss=float(means[5]),
        entropy=float(entropy(network.log_std.detach())),
        kl=kl,
        clip_fraction=float(means[3]),
        weight=float(about[0]) / share.frames,
        gradient_norm=float(means[4]),
        explained_variance=explained,
        learning_rate=learning_rate,
        finite=finite,
    )
