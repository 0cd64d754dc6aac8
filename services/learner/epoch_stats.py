"""The progress of training and the result of one epoch, as values."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from common.comms.messages import Rollout
from common.task.reward import TERMS
from common.task.states import Outcome
from services.learner.curriculum import Trained
from services.learner.divergence import Health
from services.learner.ppo import UpdateStats


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of training: with the tensors, it decides the next epoch."""

    version: int = 0  # updates done: the policy's version
    epoch: int = 0
    frames: int = 0
    stage: int = 1
    stage_number: int = 0  # stage changes so far
    epochs_in_stage: int = 0
    learning_rate: float = 5e-4
    catch_rate: float = float("nan")  # running, with exploration noise
    refitting: bool = False  # after a stage change the critic learns the new rewards first
    health: Health = field(default_factory=Health)
    rollbacks: int = 0  # times that training went back to a good checkpoint
    closing: int = 0  # datasets that the stage still takes after its gate has opened; 0: it has not opened
    refitting_since: int = 0  # epoch of the stage in which refitting began

    @property
    def trained(self) -> Trained:
        """How much is trained, as the curriculum counts it."""
        return Trained(self.stage, self.epochs_in_stage, self.epoch, self.frames)

    @property
    def is_worth_going_back_to(self) -> bool:
        """Whether a diverged run may go back to a checkpoint of now.

        The start of a stage is one: until the stage has a measure, the last good checkpoint is of the stage before.
        """
        return self.health.is_good or (self.stage_number > 0 and self.epochs_in_stage == 0)


@dataclass(frozen=True, slots=True)
class PlayStats:
    """Results of the rallies in one dataset. Unvalidated rallies are left out of all rates."""

    rallies: int
    caught: int
    over: int
    returned: int
    error_sum: float  # [m] over returned rallies
    outcomes: npt.NDArray[np.int64]  # (13,) by states.Outcome
    unvalidated: int
    mean_return: float
    reward_terms: npt.NDArray[np.float64]  # (8,) mean per frame, reward.TERMS

    @property
    def catch_rate(self) -> float:
        """Share of the rallies in which the racket touched the ball. All rates are nan where no rally ended."""
        return _share(self.caught, self.rallies)

    @property
    def over_rate(self) -> float:
        """Share of the rallies in which the ball went over the net."""
        return _share(self.over, self.rallies)

    @property
    def return_rate(self) -> float:
        """Share of the rallies in which the ball landed on the opponent's court."""
        return _share(self.returned, self.rallies)

    @property
    def target_error(self) -> float:
        """Mean distance of the landings to the target [m]; nan without landings."""
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
    diverged: str  # why training has diverged, or ""
    lag: float  # mean of (version before the update - version that played)
    frames: int


def play_stats(rollouts: Sequence[Rollout]) -> PlayStats:
    """Return the counts over the rallies that ended in ``rollouts``."""
    episodes = [rollout.episodes for rollout in rollouts]
    outcome = np.concatenate([e.outcome for e in episodes])
    rated = ~np.concatenate([e.unvalidated for e in episodes])
    landed = np.concatenate([e.landed for e in episodes]) & rated
    error = np.concatenate([e.target_error for e in episodes])
    returns = np.concatenate([e.returns for e in episodes])
    frames = sum(r.rewards.size for r in rollouts)
    terms = np.sum([r.reward_terms.astype(np.float64) for r in rollouts], axis=0) / frames
    return PlayStats(
        rallies=int(rated.sum()),
        caught=int((np.concatenate([e.caught for e in episodes]) & rated).sum()),
        over=int((np.concatenate([e.over for e in episodes]) & rated).sum()),
        returned=int(landed.sum()),
        error_sum=float(error[landed].sum(dtype=np.float64)),
        outcomes=np.bincount(outcome[rated], minlength=len(Outcome))[: len(Outcome)],
        unvalidated=int((~rated).sum()),
        mean_return=float(returns[rated].mean()) if rated.any() else float("nan"),
        reward_terms=terms if terms.size else np.zeros(len(TERMS)),
    )
