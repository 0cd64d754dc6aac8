"""The settings of commands that make a film, and the film."""

import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from common.evaluation.rally_recorder import RecordedRally
from topspin.render.film import FilmOptions, picture_count, pictures, write_film
from topspin.render.gl import Image
from topspin.render.overlay import ScoreCard

log = logging.getLogger(__name__)


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


def film(
    path: Path,
    rallies: Sequence[RecordedRally],
    config: FilmConfig,
    note: str,
    on_tick: Callable[[], None],
    card: ScoreCard | None = None,
) -> None:
    """Write the film of ``rallies`` with ``note`` in its pictures and ``card`` at its end.

    ``on_tick`` is called between pictures. A terminal shows a bar with the time that is left.
    """
    options = FilmOptions(
        config.width,
        config.height,
        config.rate_hz,
        config.slow,
        config.slow_at_hit,
        config.camera,
        note=note,
    )
    count = picture_count(rallies, options, card)
    log.info("filming rallies=%d pictures=%d file=%s", len(rallies), count, path)
    progress = Progress(
        TextColumn("filming"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("pictures,"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )

    def frames() -> Iterator[Image]:
        for picture in progress.track(pictures(rallies, options, card), count):
            on_tick()
            yield picture

    with progress:
        write_film(path, frames(), config.width, config.height, config.rate_hz)
