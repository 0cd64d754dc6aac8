"""The three-stage curriculum: which stage an epoch belongs to, and the learning rate's bound in it.

Stage 1 pays for catching, stage 2 for hitting forward fast, stage 3 for landing near the target (the paper, section
III-C). Weights carry over. At a stage change the observation normaliser's count is reset, and the next column of the
reward matrix R applies.
"""

from pydantic import BaseModel, ConfigDict, Field


class CurriculumConfig(BaseModel):
    """Lengths of the stages in epochs; an epoch is one dataset and its updates."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage_1: int = Field(244, ge=0, description="epochs of stage 1, catching (2 M frames of 8,192 an epoch)")
    stage_2: int = Field(122, ge=0, description="epochs of stage 2, hitting (1 M frames)")
    stage_3: int = Field(14282, ge=0, description="epochs of stage 3, aiming (117 M frames)")
    first_stage: int = Field(1, ge=1, le=3, description="stage to start in; 3 skips the curriculum")
    catch_gate: float = Field(
        0.0, ge=0, le=1, description="leave stage 1 early once this share is caught in training; 0: never"
    )
    aiming_log_std: float = Field(
        -2.5,
        ge=-5,
        le=1,
        description="log of the action noise is at most this as stage 3 begins: hit corrections need strokes "
        "that the noise does not hide",
    )

    @property
    def epochs(self) -> int:
        """Return the epochs of all stages from the first one."""
        return sum((self.stage_1, self.stage_2, self.stage_3)[self.first_stage - 1 :])


def next_stage(stage: int, epochs_in_stage: int, catch_rate: float, config: CurriculumConfig) -> int:
    """Return the stage of the next epoch.

    Args:
        stage: Of the epoch just trained.
        epochs_in_stage: Epochs trained in it so far.
        catch_rate: Measured over the last epochs with exploration noise; nan: not measured.
        config: Lengths and gates.
    """
    if stage == 1 and 0 < config.catch_gate <= catch_rate:
        return 2
    length = (config.stage_1, config.stage_2, config.stage_3)[stage - 1]
    if stage < 3 and epochs_in_stage >= length:
        following = stage + 1
        return following if following == 3 or config.stage_2 > 0 else 3
    return stage


def decayed(gone: float, highest: float, lowest: float) -> float:
    """Return a learning rate that falls linearly from ``highest`` to ``lowest`` as ``gone`` rises from 0 to 1."""
    return highest + min(gone, 1.0) * (lowest - highest)


def learning_rate_bound(
    stage: int, epochs_in_stage: int, highest: float, lowest: float, config: CurriculumConfig
) -> float:
    """Return the learning rate's upper bound: constant, then linear to ``lowest`` over the last stage."""
    if stage < 3 or config.stage_3 == 0:
        return highest
    return decayed(epochs_in_stage / config.stage_3, highest, lowest)
