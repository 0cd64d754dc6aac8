"""Settings of a generator."""

from typing import ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.service.settings import Fleet, ServiceConfig
from common.task.config import TaskConfig


class GeneratorOptions(BaseModel):
    """How fast rallies are published."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    batch: int = Field(
        128, ge=1, le=1000, description="rallies a message", json_schema_extra={"unit": "rallies"}
    )
    rate_hz: float = Field(
        1200.0,
        gt=0,
        le=1e6,
        description="rallies published to each shard",
        json_schema_extra={"unit": "rallies/s"},
    )


class GeneratorConfig(ServiceConfig, Fleet, GeneratorOptions):
    """Publish valid rallies for the actors of a run.

    Launch preset, randomization and flight of [task] decide the rallies. They must be the same as the actors'.
    """

    often: ClassVar = {
        "The run": ("run", "endpoint", "index", "generators", "actors", "metrics_port"),
        "Rallies": ("rate_hz", "task.launch", "task.randomization", "seed"),
    }

    index: int = Field(
        0, ge=0, exclude=True, description="number of this generator, from 0; decides its shards"
    )
    task: TaskConfig = TaskConfig()

    @model_validator(mode="after")
    def _is_one_of_the_generators(self) -> Self:
        if self.index >= self.generators:
            raise ValueError(
                f"index {self.index}; allowed: 0 to {self.generators - 1}, of {self.generators} generators"
            )
        return self
