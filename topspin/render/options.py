"""The settings of commands that make a film, and the film."""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from common.evaluation.rally_recorder import RecordedRally
from topspin.render.film import FilmOptions, picture_count, pictures, write_film
from topspin.render.gl import Image

log = logging.getLogger(__name__)


Camera = Literal["side", "behind", "target", "follow"]


class FilmConfig(BaseModel):
    """Settings of a film."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    camera: Camera = Field("side", description="place of the camera; follow moves with the ball")
    slow: float = Field(
        1.0, ge=0.05, le=1, description="speed of the film; 0.25 is four times slower than real time"
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


def film(
    path: Path,
    rallies: Sequence[RecordedRally],
    config: FilmConfig,
    note: str,
    on_tick: Callable[[], None],
) -> None:
    """Write the film of ``rallies`` with ``note`` in its pictures; ``on_tick`` is called between pictures."""
    options = FilmOptions(config.width, config.height, config.rate_hz, config.slow, config.camera, note=note)
    log.info("filming rallies=%d pictures=%d file=%s", len(rallies), picture_count(rallies, options), path)

    def frames() -> Iterator[Image]:
        for picture in pictures(rallies, options):
            on_tick()
            yield picture

    write_film(path, frames(), config.width, config.height, config.rate_hz)
