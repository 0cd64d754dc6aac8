"""The learner's state and one epoch of it: datasets in, updates out. No clock, no network, no files."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import torch

from common.comms.messages import Rollout
from common.env.rally_env import TeacherConfig
from common.env.teacher import COMING, NOTE_JOINTS
from common.policy.actor_critic import ActorCritic, NetworkConfig, log_prob
from common.policy.normalizer import Moments, normalize
from common.policy.weights import new_network
from common.rally.observation import (
    OBSERVATION,
    PAPER_OBSERVATION,
    ObservationConfig,
    critic_layout,
    offsets,
    size,
)
from common.rally.reward import TERMS
from services.learner.advantage import gae
from services.learner.arm import Arm
from services.learner.curriculum import CurriculumConfig, decayed, learning_rate_bound, next_stage
from services.learner.guard import GuardConfig, Health, divergence, running_mean, watched
from services.learner.ppo import (
    Dataset,
    Lesson,
    PPOConfig,
    UpdateStats,
    arithmetic,
    denormalized,
    explained_variance,
    update,
)
from services.learner.through_arm import Motion

Floats = npt.NDArray[np.float32]

_JOINTS = slice(offsets(OBSERVATION)["joint_pos"].start, offsets(OBSERVATION)["joint_vel"].stop)

NOTE_WEIGHT = 3.0  # besides 1: what is read from a note is a difference of a tenth of what it holds
AVERAGE_DECAY = 0.99  # of the weights' running mean, a dataset: it looks back over some 0.8 M frames


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
    refitting: bool = False  # the stage has changed, and the critic learns its rewards first
    health: Health = field(default_factory=Health)
    rollbacks: int = 0  # times that training went back to a good checkpoint
    closing: int = 0  # datasets that the stage still takes once its gate has opened; 0: it hasn't
    refitting_since: int = 0  # epoch of the stage in which the critic began to

    @property
    def is_worth_going_back_to(self) -> bool:
        """Whether a checkpoint of now may be the one to go back to.

        A stage begins with one: until its measure speaks, the last good one is of the stage before.
        """
        return self.health.is_good or (self.stage_number > 0 and self.epochs_in_stage == 0)


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

    @property
    def catch_rate(self) -> float:
        """Share of the rallies in which the racket met the ball; as all rates nan where no rally ended."""
        return _share(self.caught, self.rallies)

    @property
    def over_rate(self) -> float:
        """Share of the rallies in which the ball went over the net."""
        return _share(self.over, self.rallies)

    @property
    def return_rate(self) -> float:
        """Share of the rallies in which it landed on the opponent's court."""
        return _share(self.returned, self.rallies)

    @property
    def target_error(self) -> float:
        """Mean distance of what landed to the target [m]; nan where nothing did."""
        return _share(self.error_sum, self.returned)


def _share(part: float, whole: int) -> float:
    return part / whole if whole else float("nan")


@dataclass(frozen=True, slots=True)
class EpochStats:
    """One epoch, for metrics and logs."""

    progress: Progress  # after it
    update: UpdateStats
    play: PlayStats
    stage_changed: bool
    diverged: str  # why training has diverged, or nothing
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
        notice: Datasets that a stage still takes after its gate has opened: those that are being collected then.
        observation: What policy and critic see.
        guard: When training counts as diverged.
        teacher: Who the policy learns from first.
        arm: The task's robot, where what the teacher says is learned through it; else nobody asks.
    """

    def __init__(
        self,
        ppo: PPOConfig,
        network: NetworkConfig,
        curriculum: CurriculumConfig,
        home_action: Floats,
        seed: int,
        notice: int = 1,
        observation: ObservationConfig = PAPER_OBSERVATION,
        guard: GuardConfig = GuardConfig(),
        teacher: TeacherConfig = TeacherConfig(),
        arm: Arm | None = None,
    ) -> None:
        torch.set_num_threads(1)  # more threads fight the actors for the same cores
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.network: ActorCritic = new_network(network, observation, home_action)
        # Every dataset moves the weights by its noise as well as by what it says; their mean plays better (Polyak and
        # Juditsky 1992; Hilton et al. 2022 average a policy likewise). It is what gets measured and kept.
        self.average: ActorCritic = copy.deepcopy(self.network)
        self.network_config = network
        self.obs_size = size(critic_layout(observation))
        self.ppo = ppo
        self.curriculum = curriculum
        self.notice = notice
        self.guard = guard
        self.teacher = teacher
        self.arm = arm
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=ppo.learning_rate, eps=1e-8)
        self.generator = torch.Generator().manual_seed(seed)
        self.obs_moments = Moments.initial(self.obs_size)
        self.value_moments = Moments(np.array(0.0), np.array(1.0), 1)
        self.progress = Progress(stage=curriculum.first_stage, learning_rate=ppo.learning_rate)

    @property
    def datasets_left(self) -> int:
        """How many datasets the present stage still takes, the next one included; at least 1.

        A gate may end stage 1 earlier: it speaks ``notice`` datasets ahead, so that none is collected in vain.
        """
        config, progress = self.curriculum, self.progress
        if progress.closing:
            return progress.closing
        if progress.stage == 3:  # the last stage also takes the epochs that a gate has saved
            return max(1, config.epochs - progress.epoch)
        return max(1, (config.stage_1, config.stage_2)[progress.stage - 1] - progress.epochs_in_stage)

    @property
    def is_taught(self) -> bool:
        """Whether the policy as it stands still learns from the teacher."""
        return self.teacher.teaches(self.progress.version)

    @property
    def is_finite(self) -> bool:
        """Whether every parameter is."""
        return all(bool(parameter.isfinite().all()) for parameter in self.network.parameters())

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
        # A value that explains the new rewards is what the policy waits for after a stage change.
        refitted = before.epochs_in_stage - before.refitting_since
        is_refitting = before.refitting and (
            refitted < self.ppo.refit_epochs and explained < self.ppo.refit_variance
        )
        if self.is_taught:
            self._calm(self.teacher.log_sigma)
        lesson = Lesson.NOTHING if is_refitting else Lesson.TEACHER if self.is_taught else Lesson.REWARDS
        stats = update(
            self.network,
            self.optimizer,
            data,
            self.ppo,
            self._rate(lesson, bound),
            bound,
            self.generator,
            explained,
            breathe,
            lesson,
        )
        frozen = moments = self.obs_moments
        for rollout in rollouts:
            moments = moments.merged(Moments.of(rollout.obs.reshape(-1, self.obs_size)))
            breathe()
        # At once, and with the weights below: who is answered meanwhile gets a whole policy.
        self.obs_moments = moments
        if before.stage_number > 0:
            # After a stage change the count starts at 1 again, and the moments jump to those of the next dataset: the
            # network must not play differently for it.
            for network in (self.network, self.average):
                network.renormalize(frozen, self.obs_moments)
        self._follow()
        play = play_stats(rollouts)
        frames = sum(r.rewards.size for r in rollouts)
        running = running_mean(before.catch_rate, play.catch_rate)
        # Without a look at the gate: when it opens, rollouts of this stage are on their way, and are trained on first.
        stage = next_stage(before.stage, before.epochs_in_stage + 1, float("nan"), self.curriculum)
        due = next_stage(before.stage, before.epochs_in_stage + 1, running, self.curriculum)
        closing = before.closing - 1 if before.closing else self.notice if due != stage else 0
        if before.closing == 1:
            stage = 2 if self.curriculum.stage_2 > 0 else 3
        changed = stage != before.stage
        rate = play.return_rate if before.stage == 3 else play.catch_rate
        # While the critic alone learns, the policy can't have gone wrong.
        health = before.health if is_refitting else watched(before.health, rate, self.guard)
        if changed:
            self._enter(stage)
        self.progress = Progress(
            version=before.version + 1,
            epoch=before.epoch + 1,
            frames=before.frames + frames,
            stage=stage,
            stage_number=before.stage_number + changed,
            epochs_in_stage=0 if changed else before.epochs_in_stage + 1,
            learning_rate=before.learning_rate if is_refitting else stats.learning_rate,
            refitting=changed or is_refitting,
            catch_rate=running,
            health=Health() if changed else health,
            rollbacks=before.rollbacks,
            closing=0 if changed else closing,
            refitting_since=0 if changed else before.refitting_since,
        )
        lag = float(np.mean([before.version - r.version for r in rollouts]))
        diverged = divergence(health, self.is_finite, self.guard)
        return EpochStats(self.progress, stats, play, changed, diverged, lag, frames)

    def _rate(self, lesson: Lesson, bound: float) -> float:
        """Return the learning rate that an update begins with."""
        ppo = self.ppo
        if lesson is Lesson.TEACHER:
            gone = self.progress.version / self.teacher.epochs
            return decayed(gone, ppo.learning_rate, ppo.learning_rate_min)
        return bound if lesson is Lesson.NOTHING else min(self.progress.learning_rate, bound)

    @torch.no_grad()
    def _follow(self) -> None:
        """Let the running mean of the weights take in the newest; a young mean forgets its start faster."""
        weight = max(1.0 - AVERAGE_DECAY, 1.0 / (2.0 + self.progress.version))
        for mean, newest in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(newest, weight)

    def _enter(self, stage: int) -> None:
        """Make a stage change's changes to what has been learned."""
        self.obs_moments = self.obs_moments.recounted()
        if stage == 3:
            self._calm(self.curriculum.aiming_log_sigma)

    @torch.no_grad()
    def _calm(self, log_sigma: float) -> None:
        """Let the action noise be no larger than this from now on."""
        for network in (self.network, self.average):
            network.log_sigma.clamp_(max=log_sigma)

    def forget_health(self) -> None:
        """Judge the stage's rate anew from now on."""
        self.progress = replace(self.progress, health=Health())

    def go_back(self, load: Callable[["Training"], object]) -> None:
        """Take network, optimiser and moments from an earlier moment of this run; time doesn't go back.

        Versions, frames, epochs and the stage go on, since actors hold this life's policies; where the earlier moment
        was of another stage, the change is made again, and a critic that knew other rewards than the stage's learns
        them first. The learning rate starts anew at half of what led here: the same steps on other data might lead
        here again.

        Args:
            load: Restores the earlier moment into the training it is given.
        """
        now = self.progress
        load(self)
        then = self.progress
        if is_other_stage := then.stage_number != now.stage_number:
            self._enter(now.stage)
        self.progress = replace(
            now,
            learning_rate=max(0.5 * now.learning_rate, self.ppo.learning_rate_min),
            rollbacks=now.rollbacks + 1,
            health=Health(),
            refitting=is_other_stage or then.refitting,
            refitting_since=now.epochs_in_stage,
        )

    def _dataset(self, rollouts: Sequence[Rollout]) -> tuple[Dataset, float]:
        """Return the update's data: normalised by the newest frozen copy, pi_prox and the critic computed afresh."""
        ppo, log_sigma = self.ppo, self.network.log_sigma.detach().clone()
        parts: list[tuple[torch.Tensor, ...]] = []
        advantages, returns, values_all = [], [], []
        with torch.no_grad():
            for r in rollouts:
                steps, count = r.rewards.shape
                obs = torch.from_numpy(normalize(r.obs, self.obs_moments).reshape(-1, self.obs_size))
                actions = torch.tensor(r.actions.reshape(-1, r.actions.shape[-1]))
                with arithmetic(ppo.precision):
                    mean, value = self.network(obs)
                mean, value = mean.float(), value.float()
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
                # The last of a teacher's words come when rewards are learned from: they aren't corrections of hits
                is_late = self.teacher.teaches(r.version) and not self.is_taught
                said = np.zeros_like(r.corrections) if is_late else r.corrections
                parts.append(
                    (
                        obs,
                        actions,
                        torch.tensor(r.log_mu.reshape(-1)),
                        log_prob(actions, mean, log_sigma),
                        mean,
                        torch.tensor(said.reshape(-1, said.shape[-1])),
                        torch.from_numpy(self._weights(r)).reshape(-1, r.actions.shape[-1]),
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
        obs, actions, log_mu, log_prox, mean, corrections, says = (
            torch.cat(part) for part in zip(*parts, strict=True)
        )
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
            corrections,
            says,
            self._motion(rollouts, actions),
        )
        return data, explained

    def _motion(self, rollouts: Sequence[Rollout], actions: torch.Tensor) -> Motion | None:
        """Return what the arms did under a dataset's actions (N, A), where what is said is learned through them."""
        if self.arm is None or not self.is_taught:
            return None
        frames = torch.split(torch.arange(len(actions)), [r.rewards.size for r in rollouts])
        rows = tuple(some.reshape(r.rewards.shape) for some, r in zip(frames, rollouts, strict=True))
        joints = np.concatenate([r.obs.reshape(-1, self.obs_size)[:, _JOINTS] for r in rollouts])
        ended = np.concatenate([(r.terminated | r.truncated).reshape(-1) for r in rollouts])
        return Motion.of(
            self.arm, rows, torch.from_numpy(joints), actions, torch.from_numpy(ended), self.obs_moments
        )

    def _weights(self, rollout: Rollout) -> Floats:
        """Return how much what is said of each action weighs (T, B, A): more where notes are written and held."""
        weights = np.ones_like(rollout.actions)
        if self.is_taught and self.teacher.notes:
            weights[..., NOTE_JOINTS] += NOTE_WEIGHT * rollout.obs[..., COMING, None]
        return weights

    def _values(self, obs: Floats) -> Floats:
        if len(obs) == 0:
            return np.zeros(0, np.float32)
        with arithmetic(self.ppo.precision):
            _, value = self.network(torch.from_numpy(normalize(obs, self.obs_moments)))
        return denormalized(value.float(), self.value_moments)
