"""The learner's state and one epoch of it: datasets in, updates out. No clock, no network, no files."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from common.comms.messages import Rollout
from common.policy.actor_critic import ActorCritic, NetworkConfig, log_prob
from common.policy.normalizer import Moments, normalize
from common.policy.weights import new_network
from common.rally.observation import OBSERVATION_SIZE
from common.rally.reward import TERMS
from services.learner.advantage import gae
from services.learner.curriculum import CurriculumConfig, learning_rate_bound, next_stage
from services.learner.ppo import Dataset, PPOConfig, UpdateStats, denormalized, explained_variance, update

Floats = npt.NDArray[np.float32]

CATCH_WINDOW = 0.2  # weight of the newest epoch in the running catch rate that gates look at


@dataclass(frozen=True, slots=True)
class Progress:
    """Where training stands: everything that decides what comes next but the tensors."""

    version: int = 0  # updates done: the policy's version
    epoch: int = 0
    frames: int = 0
    stage: int = 1
    stage_number: int = 0  # stage changes so far
    epochs_in_stage: int = 0
    learning_rate: float = 5e-4
    catch_rate: float = float("nan")  # running, with exploration noise


@dataclass(frozen=True, slots=True)
class PlayStats:
    """What the rallies of one dataset came to; unvalidated ones are left out of all rates."""

    rallies: int
    caught: int
    over: int
    returned: int
    error_sum: float  # [m] over returned rallies
    outcomes: npt.NDArray[np.int64]  # (13,) by trajectory.Outcome
    unvalidated: int
    mean_return: float
    reward_terms: npt.NDArray[np.float64]  # (8,) mean per frame, reward.TERMS


@dataclass(frozen=True, slots=True)
class EpochStats:
    """One epoch, for metrics and logs."""

    progress: Progress  # after it
    update: UpdateStats
    play: PlayStats
    stage_changed: bool
    lag: float  # mean of (version before the update - version that played)
    frames: int


def play_stats(rollouts: Sequence[Rollout]) -> PlayStats:
    """Return the rates' raw counts over the rallies that ended in ``rollouts``."""
    outcome = np.concatenate([r.episodes.outcome for r in rollouts])
    rated = ~np.concatenate([r.episodes.unvalidated for r in rollouts])
    landed = np.concatenate([r.episodes.landed for r in rollouts]) & rated
    error = np.concatenate([r.episodes.target_error for r in rollouts])
    returns = np.concatenate([r.episodes.returns for r in rollouts])
    frames = sum(r.rewards.size for r in rollouts)
    terms = np.sum([r.reward_terms.astype(np.float64) for r in rollouts], axis=0) / frames
    return PlayStats(
        rallies=int(rated.sum()),
        caught=int((np.concatenate([r.episodes.caught for r in rollouts]) & rated).sum()),
        over=int((np.concatenate([r.episodes.over for r in rollouts]) & rated).sum()),
        returned=int(landed.sum()),
        error_sum=float(error[landed].sum(dtype=np.float64)),
        outcomes=np.bincount(outcome[rated], minlength=13)[:13],
        unvalidated=int((~rated).sum()),
        mean_return=float(returns[rated].mean()) if rated.any() else float("nan"),
        reward_terms=terms if terms.size else np.zeros(len(TERMS)),
    )


class Training:
    """Network, optimiser, normalisers and random state of one run.

    Args:
        ppo: Hyper-parameters.
        network: Network's shape.
        curriculum: Stage lengths.
        home_action: Initial bias of the mean head (7,).
        seed: Of the network's start and the minibatches' shuffle.
    """

    def __init__(
        self,
        ppo: PPOConfig,
        network: NetworkConfig,
        curriculum: CurriculumConfig,
        home_action: Floats,
        seed: int,
    ) -> None:
        torch.set_num_threads(1)  # more threads fight the actors for the same cores
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.network: ActorCritic = new_network(network, home_action)
        self.network_config = network
        self.ppo = ppo
        self.curriculum = curriculum
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=ppo.learning_rate, eps=1e-8)
        self.generator = torch.Generator().manual_seed(seed)
        self.obs_moments = Moments.initial(OBSERVATION_SIZE)
        self.value_moments = Moments(np.array(0.0), np.array(1.0), 1)
        self.progress = Progress(stage=curriculum.first_stage, learning_rate=ppo.learning_rate)

    @property
    def datasets_left(self) -> int:
        """How many datasets the present stage still takes, the next one included; at least 1.

        A gate may end stage 1 earlier: it speaks a dataset ahead, so that none is collected in vain.
        """
        lengths = (self.curriculum.stage_1, self.curriculum.stage_2, self.curriculum.stage_3)
        return max(1, lengths[self.progress.stage - 1] - self.progress.epochs_in_stage)

    def run_epoch(
        self, rollouts: Sequence[Rollout], breathe: Callable[[], None] = lambda: None
    ) -> EpochStats:
        """Train one epoch on ``rollouts`` and go on to the next version; their order decides the result's bits.

        Args:
            rollouts: The dataset; blocks may differ in shape.
            breathe: Called between gradient steps, so that the caller can look after other things.
        """
        before = self.progress
        data, explained = self._dataset(rollouts)
        bound = learning_rate_bound(
            before.stage,
            before.epochs_in_stage,
            self.ppo.learning_rate_max,
            self.ppo.learning_rate_min,
            self.curriculum,
        )
        stats = update(
            self.network,
            self.optimizer,
            data,
            self.ppo,
            min(before.learning_rate, bound),
            bound,
            self.generator,
            explained,
            breathe,
            hold_policy=before.stage_number > 0 and before.epochs_in_stage < self.ppo.refit_epochs,
        )
        for rollout in rollouts:
            self.obs_moments = self.obs_moments.merged(Moments.of(rollout.obs.reshape(-1, OBSERVATION_SIZE)))
            breathe()
        play = play_stats(rollouts)
        frames = sum(r.rewards.size for r in rollouts)
        caught = play.caught / play.rallies if play.rallies else before.catch_rate
        old = caught if np.isnan(before.catch_rate) else before.catch_rate
        running = (1 - CATCH_WINDOW) * old + CATCH_WINDOW * caught
        stage = next_stage(before.stage, before.epochs_in_stage + 1, running, self.curriculum)
        changed = stage != before.stage
        if changed:
            self.obs_moments = self.obs_moments.recounted()
        self.progress = Progress(
            version=before.version + 1,
            epoch=before.epoch + 1,
            frames=before.frames + frames,
            stage=stage,
            stage_number=before.stage_number + changed,
            epochs_in_stage=0 if changed else before.epochs_in_stage + 1,
            learning_rate=stats.learning_rate,
            catch_rate=running,
        )
        lag = float(np.mean([before.version - r.version for r in rollouts]))
        return EpochStats(self.progress, stats, play, changed, lag, frames)

    def _dataset(self, rollouts: Sequence[Rollout]) -> tuple[Dataset, float]:
        """Return the update's data: normalised by the newest frozen copy, pi_prox and the critic computed afresh."""
        ppo, log_sigma = self.ppo, self.network.log_sigma.detach().clone()
        parts: list[tuple[torch.Tensor, ...]] = []
        advantages, returns, values_all = [], [], []
        with torch.no_grad():
            for r in rollouts:
                steps, count = r.rewards.shape
                obs = torch.from_numpy(normalize(r.obs, self.obs_moments).reshape(-1, OBSERVATION_SIZE))
                actions = torch.tensor(r.actions.reshape(-1, r.actions.shape[-1]))
                mean, value = self.network(obs)
                values = denormalized(value, self.value_moments).reshape(steps, count)
                final = np.zeros(steps * count, np.float32)
                final[r.final_index] = self._values(r.final_obs)
                advantage = gae(
                    r.rewards * np.float32(ppo.reward_scale),
                    values,
                    r.terminated,
                    r.truncated,
                    final.reshape(steps, count),
                    self._values(r.last_obs),
                    ppo.gamma,
                    ppo.gae_lambda,
                )
                parts.append(
                    (
                        obs,
                        actions,
                        torch.tensor(r.log_mu.reshape(-1)),
                        log_prob(actions, mean, log_sigma),
                        mean,
                    )
                )
                advantages.append(advantage.reshape(-1))
                returns.append((advantage + values).reshape(-1))
                values_all.append(values.reshape(-1))
        target = np.concatenate(returns)
        explained = explained_variance(target, np.concatenate(values_all))
        self.value_moments = self.value_moments.merged(Moments.of(target))
        scale = np.sqrt(self.value_moments.var + 1e-5)
        advantage = np.concatenate(advantages)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        obs, actions, log_mu, log_prox, mean = (torch.cat(part) for part in zip(*parts, strict=True))
        targets = ((target - self.value_moments.mean) / scale).astype(np.float32)
        data = Dataset(
            obs,
            actions,
            log_mu,
            log_prox,
            mean,
            log_sigma,
            torch.from_numpy(advantage),
            torch.from_numpy(targets),
        )
        return data, explained

    def _values(self, obs: Floats) -> Floats:
        if len(obs) == 0:
            return np.zeros(0, np.float32)
        _, value = self.network(torch.from_numpy(normalize(obs, self.obs_moments)))
        return denormalized(value, self.value_moments)
