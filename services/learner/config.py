"""Settings of the learner."""

from typing import ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.policy.actor_critic import NetworkConfig
from common.service.settings import Fleet, ServiceConfig
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.learner.budget import BudgetConfig
from services.learner.curriculum import CurriculumConfig
from services.learner.divergence import DivergenceConfig
from services.learner.intake import IntakeConfig
from services.learner.ppo import PPOConfig
from services.learner.training import EvaluatedWeights


class LearnerOptions(BaseModel):
    """How the learner learns."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ppo: PPOConfig = PPOConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    divergence: DivergenceConfig = DivergenceConfig()
    intake: IntakeConfig = IntakeConfig()
    evaluated_weights: EvaluatedWeights = Field(
        "mean",
        description="which weights are evaluated and saved as a policy: mean: their running mean over the last "
        "tenth of the training, at most 100 datasets; newest: those of the last update, which actors play",
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
    history: str = Field(
        "", description="folder for a history: a line for each event of a rollout; empty: none"
    )


class LearnerConfig(ServiceConfig, Fleet, BudgetConfig, LearnerOptions):
    """Train a policy on the rollouts of a run's actors.

    The learner is the run's hub: start it first. [task], [network] and [experience] must be those of its actors.
    """

    often: ClassVar = (
        *("run", "resume", "actors", "minutes", "frames", "endpoint"),
        *("task.launch", "ppo.learning_rate", "curriculum.first_stage", "seed"),
    )

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

    @model_validator(mode="after")
    def _settings_fit_each_other(self) -> Self:
        if self.experience.teacher.policy and self.ppo.correction_weight == 0:
            raise ValueError(
                "ppo.correction_weight 0 with experience.teacher.policy; allowed: above 0 (a teacher needs it)"
            )
        self.curriculum.check_budget(self.frames)
        return self
