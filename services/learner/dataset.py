"""From rollouts to the update's data: one pass over the rollouts computes all that an epoch needs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.comms.messages import Rollout
from common.policy.actor_critic import log_prob
from common.policy.normalizer import Moments, normalize
from common.task.experience import TeacherConfig
from services.learner.advantage import gae
from services.learner.config import PPOConfig
from services.learner.engine import Engine
from services.learner.epoch_stats import PlayStats, merged, play_counts
from services.learner.group import ALONE, Group
from services.learner.minibatches import Dataset, Share, are_any, weight_sum
from services.learner.ppo import denormalized, explained_variance

Floats = npt.NDArray[np.float32]
OF_PARTS: Final = (
    "obs",
    "actions",
    "log_mu",
    "log_prox",
    "mean_prox",
    "corrections",
)  # of a dataset, from its parts


@dataclass(frozen=True, slots=True)
class Model:
    """The network before its update, with the moments that normalise its inputs and values."""

    engine: Engine
    obs_moments: Moments
    value_moments: Moments
    obs_size: int
    ppo: PPOConfig
    group: Group = ALONE

    def values(self, obs: Floats) -> Floats:
        """Return the critic's values [reward] of observations (N, D)."""
        if len(obs) == 0:
            return np.zeros(0, np.float32)
        _, value = self.engine.evaluate(torch.from_numpy(normalize(obs, self.obs_moments)))
        return denormalized(value, self.value_moments)


@dataclass(frozen=True, slots=True)
class Distillation:
    """How an epoch uses a teacher's corrections."""

    teacher: TeacherConfig
    is_on: bool  # the policy still imitates the teacher


@dataclass(frozen=True, slots=True)
class Batch:
    """All that an epoch needs of its rollouts."""

    data: Dataset
    share: Share  # which frames of the group's dataset they are
    explained: float  # explained variance of the values before the update
    value_moments: Moments  # after these returns
    obs_moments: tuple[Moments, ...]  # of each rollout's raw observations, over all ranks
    play: PlayStats  # over all ranks
    lag: float  # mean of (version now - version that played), over all ranks
    frames: int  # over all ranks


@dataclass(frozen=True, slots=True)
class _Part:
    """One rollout, flattened to n frames."""

    obs: Tensor  # (n, D) normalised
    actions: Tensor  # (n, A)
    log_mu: Tensor  # (n,)
    log_prox: Tensor  # (n,)
    mean_prox: Tensor  # (n, A)
    corrections: Tensor  # (n, A)
    advantages: Floats  # (n,)
    values: Floats  # (n,)
    moments: Moments  # of the raw observations


def read(
    rollouts: Sequence[Rollout],
    model: Model,
    distillation: Distillation,
    version: int,
    on_tick: Callable[[], None] = lambda: None,
) -> Batch:
    """Return the update's data: normalised by the frozen moments, with pi_prox and the critic computed again.

    In a group every rank reads its own rollouts, and statistics are those of all ranks' together.

    Args:
        rollouts: The dataset; blocks may differ in shape. Their order decides the result's bits.
        model: Network and moments before the update.
        distillation: The teacher.
        version: Of the policy before the update.
        on_tick: Called between rollouts.
    """
    log_std = model.engine.network.log_std.detach().clone()
    parts = []
    for rollout in rollouts:
        parts.append(_part(rollout, model, distillation, log_std))
        on_tick()
    parts = parts or [_nothing(model)]
    group = model.group
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in OF_PARTS}
    own = np.concatenate([np.stack((part.values, part.advantages), axis=1) for part in parts])
    # One message has all that a rank must know of another's rollouts
    told = group.gathered(
        own,
        np.array([(weight_sum(columns["log_prox"], columns["log_mu"]), are_any(columns["corrections"]))]),
        play_counts(rollouts)[None],
        np.array([float(version - rollout.version) for rollout in rollouts]),
        np.array([(*part.moments.mean, *part.moments.var, part.moments.count) for part in parts]),
    )
    frames, ratios, counts, lags, moments = zip(*told, strict=True)
    values, advantage = np.ascontiguousarray(np.concatenate(frames).T)
    first = sum(map(len, frames[: group.rank]))
    mine = slice(first, first + len(own))
    target = advantage + values
    value_moments = model.value_moments.merged(Moments.of(target))
    scale = np.sqrt(value_moments.var + 1e-5)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    weight, corrected = np.concatenate(ratios).sum(axis=0)
    return Batch(
        data=Dataset(
            **columns,
            log_std_prox=log_std,
            advantages=torch.from_numpy(advantage[mine]),
            value_targets=torch.from_numpy(((target[mine] - value_moments.mean) / scale).astype(np.float32)),
        ),
        share=Share(group, first, len(target), float(weight) / len(target), bool(corrected)),
        explained=explained_variance(target, values),
        value_moments=value_moments,
        obs_moments=tuple(_moments(row) for row in np.concatenate(moments) if row[-1]),
        play=merged(np.concatenate(counts)),
        lag=float(np.mean(np.concatenate(lags))),
        frames=len(target),
    )


def _moments(row: npt.NDArray[np.float64]) -> Moments:
    """Return moments from [mean, variance, count]."""
    mean, var = np.split(row[:-1], 2)
    return Moments(mean, var, int(row[-1]))


@torch.no_grad()
def _part(r: Rollout, model: Model, distillation: Distillation, log_std: Tensor) -> _Part:
    ppo, steps, count = model.ppo, *r.rewards.shape
    obs = torch.from_numpy(normalize(r.obs, model.obs_moments).reshape(-1, model.obs_size))
    obs = obs.to(model.engine.dtype)
    actions = torch.tensor(r.actions.reshape(-1, r.actions.shape[-1]))
    mean, value = model.engine.evaluate(obs)
    values = denormalized(value, model.value_moments).reshape(steps, count)
    final = np.zeros(steps * count, np.float32)
    final[r.final_index] = model.values(r.final_obs)
    advantage = gae(
        r.rewards * np.float32(ppo.reward_scale),
        values,
        r.terminated,
        r.truncated,
        final.reshape(steps, count),
        model.values(r.last_obs),
        ppo.gamma,
        ppo.gae_lambda,
    )
    # A teacher's last corrections arrive when the policy already learns from rewards. They are not the way home.
    is_late = distillation.teacher.teaches(r.version) and not distillation.is_on
    corrections = np.zeros_like(r.corrections) if is_late else r.corrections
    return _Part(
        obs=obs,
        actions=actions,
        log_mu=torch.tensor(r.log_mu.reshape(-1)),
        log_prox=log_prob(actions, mean, log_std),
        mean_prox=mean,
        corrections=torch.tensor(corrections.reshape(-1, corrections.shape[-1])),
        advantages=advantage.reshape(-1),
        values=values.reshape(-1),
        moments=Moments.of(r.obs.reshape(-1, model.obs_size)),
    )


def _nothing(model: Model) -> _Part:
    """Return no frames at all: of a rank whose actors have brought nothing for this dataset."""
    none = torch.zeros(0)
    network = model.engine.network
    actions = torch.zeros((0, len(network.log_std)))
    return _Part(
        obs=torch.zeros((0, model.obs_size), dtype=model.engine.dtype),
        actions=actions,
        log_mu=none,
        log_prox=none,
        mean_prox=actions,
        corrections=actions,
        advantages=np.zeros(0, np.float32),
        values=np.zeros(0, np.float32),
        moments=Moments(np.zeros(model.obs_size), np.zeros(model.obs_size), 0),
    )
