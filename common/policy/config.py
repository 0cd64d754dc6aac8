"""Settings of the network."""

from typing import Annotated

from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field


class NetworkConfig(BaseModel):
    """The network's shape and start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: tuple[Annotated[int, Ge(1), Le(4096)], ...] = Field(
        (256, 128, 128, 64, 64, 32),
        min_length=1,
        max_length=16,
        description="widths of the D2RL trunk's hidden layers",
    )
    initial_log_std: float = Field(-1.6, ge=-5, le=1, description="log of the action noise at the start")
