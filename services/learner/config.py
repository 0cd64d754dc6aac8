"""Settings of the learner."""

import math
from typing import ClassVar, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.policy.config import NetworkConfig
from common.service.settings import Fleet, ServiceConfig
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.learner.budget import BudgetConfig

LAST_STAGE = 3
# Of a quarter of a dataset (ADR-0069)
SMALLEST_MINIBATCH: Final = 2048
LARGEST_MINIBATCH: Final = 8192
FEWEST_FRAMES: Final = 32  # of a minibatch that is set
EvaluatedWeights = Literal["mean", "newest"]
Device = Literal["auto", "cpu", "cuda"]


def minibatch_of(minibatch: int, dataset: int) -> int:
    """Return the frames of a minibatch of a dataset with so many, by the setting ``minibatch`` (ADR-0069)."""
    return minibatch or min(max(dataset // 4, SMALLEST_MINIBATCH), LARGEST_MINIBATCH)


class PPOConfig(BaseModel):
    """Hyper-parameters of the update."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gamma: float = Field(0.99, gt=0, lt=1, description="discount per control step")
    gae_lambda: float = Field(0.9, ge=0, le=1, description="trace decay of the advantage")
    clip: float = Field(0.2, gt=0, lt=1, description="trust region of the probability ratio")
    mini_epochs: int = Field(4, ge=1, le=32, description="passes over a dataset")
    minibatch: int = Field(
        0,
        ge=0,
        description="of a gradient step, over all ranks; 0: a quarter of the dataset, from "
        f"{SMALLEST_MINIBATCH} to {LARGEST_MINIBATCH}",
        json_schema_extra={"unit": "frames"},
    )
    reward_scale: float = Field(0.1, gt=0, description="rewards are multiplied by this before anything else")
    value_weight: float = Field(1.0, ge=0, description="weight of the value loss (half the mean square)")
    entropy_weight: float = Field(0.0, ge=0, le=1, description="weight of the entropy bonus")
    bound_weight: float = Field(0.001, ge=0, description="weight of the loss on mean actions beyond +-1")
    gradient_norm: float = Field(1.0, gt=0, description="largest norm of the gradient")
    schedule: Literal["adaptive", "constant_then_linear"] = Field(
        "adaptive",
        description="of the learning rate: adaptive: it follows the KL divergence of each pass; constant_then_linear: "
        "learning_rate, and over the last stage linearly to learning_rate_min, as in the paper",
    )
    learning_rate: float = Field(
        5e-4, gt=0, le=0.1, description="Adam's at the start; adaptive: at most learning_rate_max"
    )
    learning_rate_min: float = Field(
        2e-5, gt=0, le=0.1, description="lower bound of the adaptation; end of the linear decay"
    )
    learning_rate_max: float = Field(
        1e-3, gt=0, le=0.1, description="upper bound of the adaptation; decays over the last stage"
    )
    target_kl: float = Field(
        0.01, gt=0, le=1, description="KL(prox, new) that the adapted learning rate aims at"
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto",
        description="of the update's matrix products (weights, losses and Adam are float32); auto: bfloat16 where the "
        "device multiplies it natively",
    )
    threads: int = Field(
        1,
        ge=1,
        le=1024,
        description="of the update; more than one pays where each has a core that no actor uses",
    )
    correction_weight: float = Field(
        500.0,
        ge=0,
        description="weight of the loss that pulls the mean action home after hits, or to a teacher's; 0: PPO alone",
    )
    refit_frames: int = Field(
        200_000,
        ge=0,
        description="after a stage change, and at a start from a policy, only the critic learns, from so many frames "
        "at most",
        json_schema_extra={"unit": "frames"},
    )
    refit_variance: float = Field(
        0.6, ge=0, le=1, description="explained variance at which the policy learns again before that"
    )

    @property
    def largest_minibatch(self) -> int:
        """Frames of a minibatch at most, whatever the dataset."""
        return self.minibatch or LARGEST_MINIBATCH

    def minibatch_of(self, dataset: int) -> int:
        """Return the frames of a minibatch of a dataset with so many frames."""
        return minibatch_of(self.minibatch, dataset)

    @model_validator(mode="after")
    def _a_minibatch_is_no_handful(self) -> Self:
        if 0 < self.minibatch < FEWEST_FRAMES:
            raise ValueError(f"minibatch {self.minibatch}; allowed: 0, or {FEWEST_FRAMES} and more")
        return self

    @model_validator(mode="after")
    def _bounds_are_in_order(self) -> Self:  # the starting rate is clipped to them when it adapts
        if self.learning_rate_min > self.learning_rate_max:
            raise ValueError(
                f"learning_rate_min {self.learning_rate_min:g}; "
                f"allowed: up to learning_rate_max, {self.learning_rate_max:g}"
            )
        if self.schedule == "constant_then_linear" and self.learning_rate_min > self.learning_rate:
            raise ValueError(
                f"learning_rate_min {self.learning_rate_min:g}; "
                f"allowed: up to learning_rate, {self.learning_rate:g}, under schedule constant_then_linear"
            )
        return self


class CurriculumConfig(BaseModel):
    """Lengths of the stages, in frames or in shares of the run's frames. A stage ends with a dataset."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage_1: int = Field(
        2_000_000, ge=0, description="length of stage 1, catching", json_schema_extra={"unit": "frames"}
    )
    stage_2: int = Field(
        1_000_000, ge=0, description="length of stage 2, hitting", json_schema_extra={"unit": "frames"}
    )
    stage_3: int = Field(
        117_000_000, ge=1, description="length of stage 3, aiming", json_schema_extra={"unit": "frames"}
    )
    stage_shares: tuple[float, ...] = Field(
        (),
        description="three shares of the frames of the run (--frames) for stages 1, 2 and 3, in place of their "
        "lengths; empty: the lengths count",
    )
    first_stage: int = Field(1, ge=1, le=3, description="stage to start in; 3 skips the curriculum")
    catch_gate: float = Field(
        0.0, ge=0, le=1, description="leave stage 1 early once this share is caught in training; 0: never"
    )
    count_reset: Literal["absorbed", "raw"] = Field(
        "absorbed",
        description="what the policy notices of a stage change, where the observation normaliser's count is set to 1: "
        "absorbed: nothing, the network's first weights follow the moments; raw: the moments jump under the same "
        "weights, as in the paper",
    )

    @model_validator(mode="after")
    def _shares_are_three(self) -> Self:
        shares = self.stage_shares
        usable = len(shares) == LAST_STAGE and min(shares) >= 0 and math.isclose(sum(shares), 1.0)
        if shares and not usable:
            raise ValueError(
                f"stage_shares {','.join(f'{share:g}' for share in shares)}; "
                "allowed: empty, or three numbers from 0 that sum to 1"
            )
        if shares and shares[-1] == 0:
            raise ValueError("stage_shares with 0 for stage 3; allowed: above 0, since stage 3 is the last")
        if self.catch_gate > 0 and not self.lengths[0]:
            raise ValueError(f"catch_gate {self.catch_gate:g} without stage 1; allowed: 0")
        return self

    def check_budget(self, frames: int) -> None:
        """Raise ValueError if stages are shares of frames that are not set, or end before the frames do."""
        if self.stage_shares and not frames:
            raise ValueError("stage_shares without frames; allowed: frames above 0, which they are shares of")
        if self.frames is not None and frames > self.frames:
            raise ValueError(
                f"frames {frames:,}; allowed: up to {self.frames:,}, the sum of the stages: lengthen "
                "curriculum.stage_3 for more"
            )

    @property
    def lengths(self) -> tuple[float, ...]:
        """Return the length of each stage, in frames or as a share; 0 for stages before the first one."""
        lengths = self.stage_shares or (self.stage_1, self.stage_2, self.stage_3)
        return tuple(0 if stage < self.first_stage else length for stage, length in enumerate(lengths, 1))

    @property
    def frames(self) -> int | None:
        """Return the frames of all stages from the first one; None: the stages are shares of the run's frames."""
        return None if self.stage_shares else int(sum(self.lengths))


class DivergenceConfig(BaseModel):
    """When training counts as diverged."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    collapse: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="share of the stage's best rate below which training has diverged; 0: never",
    )
    least: float = Field(0.2, gt=0, le=1, description="best rate from which on a stage is checked")
    patience: int = Field(
        20, ge=1, le=10_000, description="epochs below that share before training counts as diverged"
    )


class IntakeConfig(BaseModel):
    """How much data an update takes, and how old it may be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset_rollouts: int = Field(0, ge=0, description="rollouts of one dataset; 0: one of each actor")
    max_lag: int = Field(
        2,
        ge=0,
        le=64,
        description="versions that a rollout may be older than the learner's; 0 is strictly synchronous",
    )
    target_lag: int = Field(1, ge=0, le=64, description="lag that the pacing aims at, where max_lag allows")
    queue_rollouts: int = Field(
        256,
        ge=1,
        description="rollouts that may wait, which bounds the memory: a dataset at least, and two where a dataset "
        "is one rollout of each actor",
    )
    window: int = Field(2, ge=1, le=16, description="credits that one actor may hold")
    credit_patience_s: float = Field(
        30.0,
        gt=0,
        description="time without a new rollout after which an actor's credits go to others",
        json_schema_extra={"unit": "s"},
    )

    @model_validator(mode="after")
    def _a_dataset_fits_into_the_queue(self) -> Self:
        if self.dataset_rollouts > self.queue_rollouts:
            raise ValueError(
                f"dataset_rollouts {self.dataset_rollouts}; allowed: up to queue_rollouts, {self.queue_rollouts}"
            )
        return self

    @property
    def lag_aimed_at(self) -> int:
        """Return how many datasets beyond the present one are collected ahead."""
        return min(self.target_lag, self.max_lag)

    def for_actors(self, actors: int) -> Self:
        """Return the settings for so many actors: a dataset is one rollout of each, and two fit into the queue."""
        rollouts = self.dataset_rollouts or actors
        queue = self.queue_rollouts if self.dataset_rollouts else max(self.queue_rollouts, 2 * rollouts)
        return self.model_copy(update={"dataset_rollouts": rollouts, "queue_rollouts": queue})


class LearnerOptions(BaseModel):
    """How the learner learns."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start_policy: str = Field(
        "",
        description="policy that a new run starts from, by its name in the box or its folder: with its "
        "network.units and observation, in its stage or a later one; empty: new weights",
    )
    device: Device = Field(
        "cpu",
        description="where updates compute; auto: on a GPU where PyTorch finds one, otherwise on the CPU",
    )
    ppo: PPOConfig = PPOConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    divergence: DivergenceConfig = DivergenceConfig()
    intake: IntakeConfig = IntakeConfig()
    evaluated_weights: EvaluatedWeights = Field(
        "mean",
        description="which weights are evaluated and saved as a policy: mean: their running mean, over the "
        "last datasets, few in a young training and at most 100; newest: those of the last update, which actors play",
    )
    checkpoint_interval_s: float = Field(
        60.0, gt=0, description="time between checkpoints", json_schema_extra={"unit": "s"}
    )
    silence_warning_s: float = Field(
        10.0,
        gt=0,
        description="time without a dataset after which the log says what is missing",
        json_schema_extra={"unit": "s"},
    )
    writers: tuple[str, ...] = Field(
        (),
        description="more writers of the run's curves, besides TensorBoard's: wandb, mlflow, or an entry point "
        "topspin.writers of an installed package",
    )
    history: str = Field(
        "", description="folder for a history: a line for each event of a rollout; empty: none"
    )


class LearnerConfig(ServiceConfig, Fleet, BudgetConfig, LearnerOptions):
    """Train a policy on the rollouts of a run's actors.

    The learner is the run's hub: start it first. [task], [network] and [experience] must be those of its actors.
    """

    often: ClassVar = {
        "The run": ("run", "resume", "actors", "endpoint"),
        "Its end": ("minutes", "frames"),
        "Training": ("task.launch", "ppo.learning_rate", "curriculum.first_stage", "seed"),
    }

    mode: Literal["hub", "client"] = Field(
        "hub", exclude=True, description="hub: listen at the endpoint; client: connect to a router there"
    )
    task: TaskConfig = TaskConfig()
    network: NetworkConfig = NetworkConfig()
    experience: ExperienceConfig = ExperienceConfig()
    folder: str = Field("", exclude=True, description="run folder; empty: runs/RUN")
    resume: bool = Field(
        False, exclude=True, description="go on from the newest checkpoint in the run folder"
    )
    auto_resume: bool = Field(
        False,
        exclude=True,
        description="--resume if the run folder has a checkpoint, otherwise start the run: for whoever starts the "
        "learner again with the same command",
    )

    @model_validator(mode="after")
    def _settings_fit_each_other(self) -> Self:
        if self.experience.teacher.policy and self.ppo.correction_weight == 0:
            raise ValueError(
                "ppo.correction_weight 0 with experience.teacher.policy; allowed: above 0 (a teacher needs it)"
            )
        if self.id != "0":
            raise ValueError(f"id {self.id!r}; allowed: 0, which is the learner that keeps the run")
        self.curriculum.check_budget(self.frames)
        return self
