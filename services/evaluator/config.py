"""Settings of the evaluator."""

from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field

from common.evaluation.config import DEFAULT_ENVS, Environments
from common.policy.config import NetworkConfig
from common.service.settings import ServiceConfig
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig


class EvaluatorOptions(BaseModel):
    """How the newest policy is evaluated while it trains."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rallies: int = Field(1000, ge=1, le=1_000_000, description="rallies of each evaluation")
    rounds: int = Field(
        1, ge=1, le=1000, description="rallies of an episode; it continues while the robot returns the ball"
    )
    envs: Environments = DEFAULT_ENVS
    interval_s: float = Field(
        45.0, gt=0, description="time between evaluations", json_schema_extra={"unit": "s"}
    )
    keep_policies: bool = Field(
        False,
        description="keep every evaluated policy in policy/evaluated/VERSION, 0.5 MB each, and not the best alone",
    )
    niceness: int = Field(
        10, ge=0, le=19, description="niceness of the process, so that learner and actors have priority"
    )


class EvaluatorConfig(ServiceConfig, EvaluatorOptions):
    """Follow a run: evaluate its newest policy on fixed rallies, and keep the best.

    To measure one policy, use `topspin evaluate`.
    """

    often: ClassVar = {
        "The run": ("run", "endpoint", "metrics_port"),
        "Evaluations": ("rallies", "interval_s", "keep_policies", "envs", "niceness"),
        "The task": ("task.launch", "task.randomization", "seed"),
    }

    task: TaskConfig = TaskConfig()
    network: NetworkConfig = NetworkConfig()
    experience: ExperienceConfig = ExperienceConfig()
    folder: str = Field("", exclude=True, description="run folder; empty: runs/RUN")
