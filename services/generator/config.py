"""Settings of a generator."""

from typing import Literal, Self

from pydantic import Field, model_validator

from common.rally.launch_presets import PresetName
from common.service_config import ServiceConfig


class GeneratorConfig(ServiceConfig):
    """Settings of a generator: which rallies, how many, to which shards."""

    launch: PresetName = Field("paper", description="launch preset")
    noise: Literal["off", "standard", "hard"] = Field(
        "standard", description="how far drag and lift are drawn"
    )
    flight: Literal["simple", "full"] = Field("simple", description="aerodynamics; must be the actors'")
    shards: int = Field(
        1, ge=1, le=4096, description="shards in all: as many as actors, so that a rally is played once"
    )
    index: int = Field(
        0, ge=0, description="which of the generators this is: 0 up to one less than there are"
    )
    of: int = Field(1, ge=1, description="how many generators share the shards")
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

    @model_validator(mode="after")
    def _is_one_of_the_generators(self) -> Self:
        if self.index >= self.of:
            raise ValueError(f"index {self.index}; allowed: 0 to {self.of - 1}, of {self.of} generators")
        return self
