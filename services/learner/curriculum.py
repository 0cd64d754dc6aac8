"""The three-stage curriculum: which stage an epoch belongs to, and the learning rate's bound in it.

Stage 1 pays for catching, stage 2 for hitting forward fast, stage 3 for landing near the target (the paper, section
III-C). Weights carry over. At a stage change the observation normaliser's count is reset, and the next column of the
reward matrix R applies.
"""

import math
from dataclasses import dataclass

from services.learner.config import LAST_STAGE, CurriculumConfig


@dataclass(frozen=True, slots=True)
class Trained:
    """How much is trained."""

    stage: int
    began: int  # frames at which the present stage began
    epochs: int  # of the whole run
    frames: int


@dataclass(frozen=True, slots=True)
class StageLengths:
    """How long the stages of one run are, in frames.

    Args:
        config: Lengths and gates.
        frames: That the run may train; the stages' shares are shares of it.
    """

    config: CurriculumConfig
    frames: int = 0

    def lengths(self) -> tuple[int, ...]:
        """Return the frames of each stage; shares of stages before the first one go to the others."""
        wanted = self.config.lengths
        scale = self.frames / sum(wanted) if self.config.stage_shares else 1.0
        # rounded: 0.14 of 10,000 is 1,400.0000000000002, which would take one more dataset
        return tuple(round(scale * length) for length in wanted)

    def end(self, trained: Trained) -> int:
        """Return the frames at which the present stage ends: the last one also takes what a gate saved."""
        lengths = self.lengths()
        return sum(lengths) if trained.stage == LAST_STAGE else trained.began + lengths[trained.stage - 1]

    def gone(self, trained: Trained) -> float:
        """Return the share of the present stage that is trained; 1 or more: it is over."""
        length = self.end(trained) - trained.began
        return (trained.frames - trained.began) / length if length > 0 else 1.0

    def next_stage(self, trained: Trained, catch_rate: float) -> int:
        """Return the stage of the next epoch.

        Args:
            trained: With the epoch just trained.
            catch_rate: Measured over the last epochs with exploration noise; nan: not measured.
        """
        config, stage = self.config, trained.stage
        if stage == 1 and 0 < config.catch_gate <= catch_rate:
            return self.after(1)
        return self.after(stage) if stage < LAST_STAGE and self.gone(trained) >= 1.0 else stage

    def after(self, stage: int) -> int:
        """Return the stage that follows ``stage``, which is 1 or 2: a stage 2 of no length is left out."""
        return 2 if stage == 1 and self.lengths()[1] > 0 else LAST_STAGE

    def datasets_left(self, trained: Trained) -> int:
        """Return how many datasets the present stage still takes, at least 1.

        Future datasets count as large as those so far; before the first one it is 1.
        """
        left = self.end(trained) - trained.frames
        return max(1, math.ceil(left * trained.epochs / trained.frames)) if trained.frames else 1

    def learning_rate_bound(self, trained: Trained, highest: float, lowest: float) -> float:
        """Return the learning rate's upper bound: constant, then linear to ``lowest`` over the last stage."""
        return highest if trained.stage < LAST_STAGE else decayed(self.gone(trained), highest, lowest)


def decayed(gone: float, highest: float, lowest: float) -> float:
    """Return a learning rate that falls linearly from ``highest`` to ``lowest`` as ``gone`` rises from 0 to 1."""
    return highest + min(gone, 1.0) * (lowest - highest)
