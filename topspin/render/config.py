"""Settings of the commands that make a film."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

Camera = Literal["side", "behind", "target", "follow"]


class FilmConfig(BaseModel):
    """Settings of a film."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    camera: Camera = Field("side", description="place of the camera; follow moves with the ball")
    slow: float = Field(
        1.0, ge=0.05, le=1, description="speed of the film; 0.25 is four times slower than real time"
    )
    slow_at_hit: float = Field(
        0.25,
        ge=0.05,
        le=1,
        description="speed of the film around the hit, where it is slower; 1: as the rest",
    )
    width: int = Field(
        1280,
        ge=320,
        le=3840,
        multiple_of=2,
        description="width of the film",
        json_schema_extra={"unit": "pixels"},
    )
    height: int = Field(
        720,
        ge=180,
        le=2160,
        multiple_of=2,
        description="height of the film",
        json_schema_extra={"unit": "pixels"},
    )
    rate_hz: float = Field(
        50.0, ge=10, le=100, description="pictures per second of the film", json_schema_extra={"unit": "Hz"}
    )
