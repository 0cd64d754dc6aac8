"""The learner's state and one epoch of it: datasets in, updates out. No clock, no network, no files."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import torch

from common.comms.messages import Rollout
from common.env.robot import home_action
from common.errors import ReportedError
from common.policy.actor_critic import ActorCritic
from common.policy.config import NetworkConfig
from common.policy.folder import Policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.experience import TeacherConfig
from common.task.observation import PAPER_OBSERVATION, ObservationConfig, critic_layout, size
from services.learner.admission import LearnerState
from services.learner.compute import Compute, compute_of, new_engine
from services.learner.config import (
    DivergenceConfig,
    EvaluatedWeights,
    LearnerConfig,
    PPOConfig,
)
from services.learner.curriculum import StageLengths, Trained, decayed
from services.learner.dataset import Batch, Distillation, Model, read
from services.learner.divergence import Health, divergence, running_mean, watched
from services.learner.engine import Engine
from services.learner.epoch_stats import EpochStats, Progress
from services.learner.group import ALONE, Group
from services.learner.ppo import LearningRate, UpdateMode, update
from services.learner.start_policy import start_policy

Floats = npt.NDArray[np.float32]

AVERAGE_DATASETS: Final = 100  # most datasets that the weights' running mean covers: 0.8 M frames
# Before that it covers 1 + (age/120)^2 datasets: 2 after 1 M frames, 100 after 10 M. A longer mean of young weights,
# which learn fast, plays worse than they do (ADR-0012).
AVERAGE_AGE: Final = 120


class Training:
    """Network, optimiser, normalisers and random state of one run.

    Args:
        ppo: Hyper-parameters.
        network: Network's shape.
        stages: How long they are, and what happens between them.
        home_action: Initial bias of the mean head (7,).
        seed: Of the network's initial weights and the minibatches' shuffle.
        notice: Datasets that a stage still takes after its gate has opened: actors already collect them.
        observation: What policy and critic observe.
        divergence: When training counts as diverged.
        teacher: The policy that it learns from first, if any.
        compute: What updates compute with; None: the CPU, as ``ppo`` says.
    """

    def __init__(
        self,
        ppo: PPOConfig,
        network: NetworkConfig,
        stages: StageLengths,
        home_action: Floats,
        seed: int,
        notice: int = 1,
        observation: ObservationConfig = PAPER_OBSERVATION,
        divergence: DivergenceConfig = DivergenceConfig(),
        teacher: TeacherConfig = TeacherConfig(),
        compute: Compute | None = None,
    ) -> None:
        self.compute = compute or compute_of(ppo)
        torch.set_num_threads(self.compute.threads)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.network: ActorCritic = new_network(network, observation, home_action)
        # The noise of every dataset also moves the weights. Their running mean plays better (Polyak and Juditsky 1992;
        # Hilton et al. 2022 average a policy in the same way).
        self.average: ActorCritic = copy.deepcopy(self.network)
        self.network_config = network
        self.obs_size = size(critic_layout(observation))
        self.ppo = ppo
        self.stages, self.curriculum = stages, stages.config
        self.notice = notice
        self.divergence = divergence
        self.teacher = teacher
        # The learners that train together: set before the first epoch. All are made with the same arguments.
        self.group: Group = ALONE
        self.engine: Engine = new_engine(self.network, ppo, self.compute)
        self.generator = torch.Generator().manual_seed(seed)
        self.obs_moments = Moments.initial(self.obs_size)
        self.value_moments = Moments(np.array(0.0), np.array(1.0), 1)
        self.progress = Progress(stage=self.curriculum.first_stage, learning_rate=ppo.learning_rate)
        self.has_start_policy = False  # whether the run began with a trained policy

    @torch.no_grad()
    def start_from(self, policy: Policy) -> None:
        """Take over a trained policy before the first epoch. The new critic learns first, and then both, slowly.

        Args:
            policy: Of the same network and observation (``start_policy``).
        """
        for network in (self.network, self.average):
            for own, theirs in zip(
                network.policy_parameters(), policy.network.policy_parameters(), strict=True
            ):
                own.copy_(theirs)
        self.engine.refresh()
        self.obs_moments = policy.moments.followed_by(self.obs_moments).recounted()
        self.progress = replace(self.progress, learning_rate=self.ppo.learning_rate_min, refitting=True)

    @property
    def optimizer(self) -> torch.optim.Optimizer:
        """The optimiser of the network's parameters."""
        return self.engine.optimizer

    @property
    def datasets_left(self) -> int:
        """Number of datasets that the present stage still takes, with the next one; at least 1.

        A gate may end stage 1 earlier. It opens ``notice`` datasets ahead, so that no collected dataset is lost.
        """
        return self.progress.closing or self.stages.datasets_left(self.progress.trained)

    @property
    def is_distilling(self) -> bool:
        """Whether the policy still learns from the teacher."""
        return self.teacher.teaches(self.progress.version)

    @property
    def is_finite(self) -> bool:
        """Whether every parameter is finite."""
        return all(bool(parameter.isfinite().all()) for parameter in self.network.parameters())

    def state_of(self, run: str, generation: int, training_hash: str) -> LearnerState:
        """Return what verdicts on rollouts depend on."""
        progress = self.progress
        return LearnerState(
            run=run,
            generation=generation,
            version=progress.version,
            stage_number=progress.stage_number,
            stage=progress.stage,
            training_hash=training_hash,
            datasets_left=self.datasets_left,
        )

    def run_epoch(
        self, rollouts: Sequence[Rollout], on_tick: Callable[[], None] = lambda: None
    ) -> EpochStats:
        """Train one epoch on ``rollouts`` and go on to the next version; their order decides the result's bits.

        Args:
            rollouts: The dataset; blocks may differ in shape.
            on_tick: Called between gradient steps, so that the caller can do other work.
        """
        before = self.progress
        batch = self.read(rollouts, on_tick)
        self.value_moments = batch.value_moments
        ppo = self.ppo
        highest = ppo.learning_rate_max if ppo.schedule == "adaptive" else ppo.learning_rate
        bound = self.stages.learning_rate_bound(before.trained, highest, ppo.learning_rate_min)
        # After a stage change the policy waits for a critic that explains the new rewards.
        refitted = (before.epochs_in_stage - before.refitting_since) * batch.frames
        is_refitting = before.refitting and (
            refitted < self.ppo.refit_frames and batch.explained < self.ppo.refit_variance
        )
        mode = (
            UpdateMode.CRITIC_ONLY
            if is_refitting
            else UpdateMode.DISTILL
            if self.is_distilling
            else UpdateMode.PPO
        )
        stats = update(
            self.engine,
            batch.data,
            ppo,
            LearningRate(self._rate(mode, bound), bound),
            self.generator,
            batch.explained,
            on_tick,
            mode,
            batch.share,
        )
        frozen = moments = self.obs_moments
        for part in batch.obs_moments:
            moments = moments.merged(part)
        # No tick until the weights below have changed too: a request then gets a consistent policy.
        self.obs_moments = moments
        was_recounted = before.stage_number > 0 or self.has_start_policy
        if was_recounted and self.curriculum.count_reset == "absorbed":
            # After a stage change the count starts at 1 again, and the moments jump to those of the next datasets. The
            # network must not play differently because of it.
            if before.version == 0:  # the new critic's own numbers had no moments before
                frozen = frozen.first(self.network.obs_size).followed_by(moments)
            for network in (self.network, self.average):
                network.renormalize(frozen, self.obs_moments)
        self._update_ema()
        play = batch.play
        running = running_mean(before.catch_rate, play.catch_rate)
        # The gate is left out here: when it opens, rollouts of this stage are in flight, and are trained on first.
        trained = Trained(before.stage, before.began, before.epoch + 1, before.frames + batch.frames)
        stage, due = (self.stages.next_stage(trained, rate) for rate in (float("nan"), running))
        opens = min(self.notice, self.stages.datasets_left(trained)) if due != stage else 0
        closing = before.closing - 1 if before.closing else opens
        if before.closing == 1:
            stage = self.stages.after(before.stage)
        changed = stage != before.stage
        rate = play.return_rate if before.stage == 3 else play.catch_rate
        # While only the critic learns, the policy cannot diverge.
        health = before.health if is_refitting else watched(before.health, rate, self.divergence)
        if changed:
            self.obs_moments = self.obs_moments.recounted()
        self.progress = Progress(
            version=before.version + 1,
            epoch=trained.epochs,
            frames=trained.frames,
            stage=stage,
            stage_number=before.stage_number + changed,
            epochs_in_stage=0 if changed else before.epochs_in_stage + 1,
            began=trained.frames if changed else before.began,
            learning_rate=before.learning_rate if is_refitting else stats.learning_rate,
            refitting=changed or is_refitting,
            catch_rate=running,
            health=Health() if changed else health,
            rollbacks=before.rollbacks,
            closing=0 if changed else closing,
            refitting_since=0 if changed else before.refitting_since,
        )
        diverged = divergence(health, self.is_finite, self.divergence)
        return EpochStats(self.progress, stats, play, changed, diverged, batch.lag, batch.frames)

    def read(self, rollouts: Sequence[Rollout], on_tick: Callable[[], None] = lambda: None) -> Batch:
        """Return the data of the next epoch from its rollouts; nothing is changed."""
        self.engine.refresh()
        model = Model(self.engine, self.obs_moments, self.value_moments, self.obs_size, self.ppo, self.group)
        distillation = Distillation(self.teacher, self.is_distilling)
        return read(rollouts, model, distillation, self.progress.version, on_tick)

    def _rate(self, mode: UpdateMode, bound: float) -> float:
        """Return the learning rate at the start of an update: half of its schedule's for each rollback."""
        ppo = self.ppo
        if mode is UpdateMode.PPO and ppo.schedule == "adaptive":
            return min(self.progress.learning_rate, bound)  # a rollback has halved it
        scheduled = bound
        if mode is UpdateMode.DISTILL:
            share = self.progress.version / self.teacher.epochs
            scheduled = decayed(share, ppo.learning_rate, ppo.learning_rate_min)
        return max(scheduled * 0.5**self.progress.rollbacks, ppo.learning_rate_min)

    def weights(self, which: EvaluatedWeights) -> ActorCritic:
        """Return the network with the newest weights, or the one with their running mean."""
        return self.average if which == "mean" else self.network

    @torch.no_grad()
    def _update_ema(self) -> None:
        """Update the running mean of the weights."""
        age = self.progress.version + 1
        weight = 1.0 / min(1.0 + (age / AVERAGE_AGE) ** 2, AVERAGE_DATASETS)
        torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), weight)

    def forget_health(self) -> None:
        """Start the stage's measure again."""
        self.progress = replace(self.progress, health=Health())

    def go_back(self, load: Callable[["Training"], object]) -> None:
        """Take network, optimiser and moments from an earlier checkpoint of this run. Counts do not go back.

        Versions, frames, epochs and the stage go on, since actors have this process's policies. If the checkpoint is
        of another stage, the stage change is made again, and the critic learns the new rewards first. The learning rate
        starts at half of its value now, since the same steps on other data might diverge again.

        Args:
            load: Restores the checkpoint into the training it is given.
        """
        now = self.progress
        load(self)
        then = self.progress
        if is_other_stage := then.stage_number != now.stage_number:
            self.obs_moments = self.obs_moments.recounted()
        self.progress = replace(
            now,
            learning_rate=max(0.5 * now.learning_rate, self.ppo.learning_rate_min),
            rollbacks=now.rollbacks + 1,
            health=Health(),
            refitting=is_other_stage or then.refitting,
            refitting_since=now.epochs_in_stage,
        )


def new_training(config: LearnerConfig, group: Group = ALONE) -> Training:
    """Return the training of a run at its start, of one rank of a group.

    Raises:
        PolicyError: The policy that it is to start from does not fit.
        ReportedError: There is no such device, or the ranks have devices of several kinds, which can't sum together.
    """
    compute = compute_of(config.ppo, config.device)
    kinds = {kind.decode() for (kind,) in group.gathered_bytes([compute.device.type.encode()])}
    if len(kinds) > 1:
        raise ReportedError(
            f"a group with learners on {' and '.join(sorted(kinds))}; allowed: one --device for all"
        )
    training = Training(
        config.ppo,
        config.network,
        StageLengths(config.curriculum, config.frames),
        home_action(config.task.robot),
        config.seed,
        notice=max(1, config.intake.lag_aimed_at),
        observation=config.task.observation,
        divergence=config.divergence,
        teacher=config.experience.teacher,
        compute=compute,
    )
    training.group = group
    training.has_start_policy = bool(config.start_policy)
    if (policy := start_policy(config)) is not None:
        training.start_from(policy)
    return training
