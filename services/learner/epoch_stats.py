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
    began: int = 0  # frames at which the stage began
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
        return Trained(self.stage, self.began, self.epoch, self.frames)

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


def merged(parts: npt.NDArray[np.float64]) -> PlayStats:
    """Return the results of several datasets together, from each one's ``play_counts``: (datasets, C)."""
    total = np.sum(parts, axis=0)
    rallies, caught, over, returned, unvalidated = (int(count) for count in total[:5])
    error_sum, return_sum, frames = (float(value) for value in total[5:8])
    outcomes, terms = np.split(total[8:], [len(Outcome)])
    return PlayStats(
        rallies=rallies,
        caught=caught,
        over=over,
        returned=returned,
        error_sum=error_sum,
        outcomes=outcomes.astype(np.int64),
        unvalidated=unvalidated,
        mean_return=_share(return_sum, rallies),
        reward_terms=terms / frames,
    )


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


def play_counts(rollouts: Sequence[Rollout]) -> npt.NDArray[np.float64]:
    """Return what ``merged`` takes: counts and sums over the rallies that ended in ``rollouts``, as one vector."""
    if not rollouts:  # a rank of a group may bring none
        return np.zeros(8 + len(Outcome) + len(TERMS))
    episodes = [rollout.episodes for rollout in rollouts]
    outcome = np.concatenate([e.outcome for e in episodes])
    rated = ~np.concatenate([e.unvalidated for e in episodes])
    landed = np.concatenate([e.landed for e in episodes]) & rated
    error = np.concatenate([e.target_error for e in episodes])
    returns = np.concatenate([e.returns for e in episodes])
    frames = sum(r.rewards.size for r in rollouts)
    terms = np.sum([r.reward_terms.astype(np.float64) for r in rollouts], axis=0)
    return np.concatenate(
        [
            [rated.sum(), (np.concatenate([e.caught for e in episodes]) & rated).sum()],
            [(np.concatenate([e.over for e in episodes]) & rated).sum(), landed.sum(), (~rated).sum()],
            [error[landed].sum(dtype=np.float64), returns[rated].sum(dtype=np.float64), frames],
            np.bincount(outcome[rated], minlength=len(Outcome))[: len(Outcome)],
            terms if terms.size else np.zeros(len(TERMS)),
        ]
    )
