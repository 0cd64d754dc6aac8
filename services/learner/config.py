"""Settings of the learner."""

from typing import Literal, Self

from pydantic import Field, model_validator

from common.env.rally_env import EnvConfig
from common.policy.actor_critic import NetworkConfig
from common.rally.launch_presets import PresetName
from common.service_config import ServiceConfig
from services.learner.curriculum import CurriculumConfig
from services.learner.guard import GuardConfig
from services.learner.intake import IntakeConfig
from services.learner.ppo import PPOConfig


class LearnerConfig(ServiceConfig):
    """Settings of the learner; task and network are those its actors must have."""

    mode: Literal["hub", "client"] = Field(
        "hub", description="be the hub that listens at the endpoint, or dial one"
    )
    env: EnvConfig = EnvConfig()
    network: NetworkConfig = NetworkConfig()
    ppo: PPOConfig = PPOConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    guard: GuardConfig = GuardConfig()
    intake: IntakeConfig = IntakeConfig()
    launch: PresetName = Field("paper", description="launch preset, as the generators'")
    folder: str = Field("", description="run folder; empty: runs/RUN")
    resume: bool = Field(False, description="go on from the newest checkpoint in the run folder")
    minutes: float = Field(
        0.0,
        ge=0,
        description="stop this long after the first trained batch, counted through restarts; 0: no limit",
        json_schema_extra={"unit": "min"},
    )
    frames: int = Field(
        0, ge=0, description="stop after this many trained frames, counted through restarts; 0: no limit"
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

    @model_validator(mode="after")
    def _a_teacher_is_heard(self) -> Self:
        if self.env.teacher.policy and self.ppo.correction_weight == 0:
            raise ValueError(
                "ppo.correction_weight 0 beside env.teacher.policy; allowed: above 0, or nobody learns what it says"
            )
        return self
