"""Filming rallies for the commands that do: the settings they share, and the film itself."""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from common.render.film import FilmOptions, picture_count, pictures, write_film
from common.render.gl import Image
from common.render.rally_recorder import RecordedRally

log = logging.getLogger(__name__)


class FilmConfig(BaseModel):
    """How a command films."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    camera: Literal["side", "behind", "target", "follow"] = Field(
        "side", description="where the film is taken from; follow goes with the ball"
    )
    slow: float = Field(
        1.0, ge=0.05, le=1, description="speed of the film; 0.25 is four times slower than real time"
    )
    width: int = Field(
        1280, ge=320, le=3840, multiple_of=2, description="of the film", json_schema_extra={"unit": "pixels"}
    )
    height: int = Field(
        720, ge=180, le=2160, multiple_of=2, description="of the film", json_schema_extra={"unit": "pixels"}
    )
    rate_hz: float = Field(
        50.0, ge=10, le=100, description="pictures a second", json_schema_extra={"unit": "Hz"}
    )


def film(
    path: Path,
    rallies: Sequence[RecordedRally],
    config: FilmConfig,
    note: str,
    breathe: Callable[[], None],
) -> None:
    """Write the film of ``rallies`` with ``note`` in its pictures; ``breathe`` is called between pictures."""
    options = FilmOptions(config.width, config.height, config.rate_hz, config.slow, config.camera, note=note)
    log.info("filming rallies=%d pictures=%d file=%s", len(rallies), picture_count(rallies, options), path)

    def watched() -> Iterator[Image]:
        for picture in pictures(rallies, options):
            breathe()
            yield picture

    write_film(path, watched(), config.width, config.height, config.rate_hz)
