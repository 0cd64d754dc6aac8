"""Films of rallies: H.264 in an mp4 that every browser plays."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from common.evaluation.rally_recorder import RecordedRally
from common.service.whole_file import make_writable
from common.task.states import Outcome
from topspin.progress import bar
from topspin.render.config import FilmConfig
from topspin.render.gl import Image, RenderError, wanted
from topspin.render.overlay import OUTCOME_WORDS, Caption, Lettering, ScoreCard
from topspin.render.replay import BallPath, moment_at, path_of, position_at, spin_word
from topspin.render.scene import CAMERAS, Camera, CameraName, Painter

log = logging.getLogger(__name__)

HOLD_S: Final = 0.8  # the last picture of a rally is held, so that its text can be read
FADE_S: Final = 0.12  # from one rally into the next
CARD_S: Final = 4.0  # the score card at the end
AROUND_HIT_S: Final = 0.10  # slow motion begins so long before the hit, and ends so long after it
_QUALITY: Final = "21"  # x264's crf: a smaller one gives better and larger files
_FOLLOWS_WITHIN_S: Final = (
    0.25  # [s] the following camera looks at the ball's mean position over this time before and after
)
_INSET: Final = (0.22, 0.28)  # of the picture's width and height: close view of the ball
_INSET_DISTANCE: Final = 0.36  # [m]


@dataclass(frozen=True, slots=True)
class FilmOptions:
    """How a film looks."""

    width: int = 1280  # [pixels] even
    height: int = 720  # [pixels] even
    rate_hz: float = 50.0  # pictures per second
    slow: float = 1.0  # rally seconds per film second
    slow_at_hit: float = 1.0  # the same around the hit, where it is slower
    camera: CameraName = "side"
    note: str = ""  # written on every picture


def check_tools(path: Path) -> None:
    """Raise RenderError if no film can be made here, or none at ``path``; called before the rallies are played."""
    try:
        make_writable(path.parent)
    except OSError as error:
        raise RenderError(f"can't write {path}: {error.strerror}") from None
    for module in ("imageio_ffmpeg", "PIL.Image"):
        wanted(module)
    with Painter(64, 64):
        pass


def picture_times(rally: RecordedRally, options: FilmOptions) -> list[float]:
    """Return the times [s] since launch of a rally's moving pictures; the last is its end."""
    times, time, end = [], 0.0, float(rally.time[-1])
    while time < end - 1e-9:
        times.append(time)
        time += speed_at(rally, time, options) / options.rate_hz
    return [*times, end]


def hit_time(rally: RecordedRally) -> float | None:
    """Return when the racket hits the ball [s]; None where it does not."""
    hits = np.flatnonzero(rally.state == 2)
    return float(rally.time[hits[0]]) if len(hits) else None


def speed_at(rally: RecordedRally, time: float, options: FilmOptions) -> float:
    """Return the film's speed at ``time`` [s]: rally seconds per film second."""
    hit = hit_time(rally)
    is_near = hit is not None and abs(time - hit) < AROUND_HIT_S
    return min(options.slow, options.slow_at_hit) if is_near else options.slow


def picture_count(
    rallies: Sequence[RecordedRally], options: FilmOptions, card: ScoreCard | None = None
) -> int:
    """Return how many pictures ``pictures`` makes of ``rallies``."""
    moving = sum(len(picture_times(rally, options)) for rally in rallies)
    hold, fade = round(HOLD_S * options.rate_hz), round(FADE_S * options.rate_hz)
    last = 0 if card is None else fade + round(CARD_S * options.rate_hz)
    return moving + hold * len(rallies) + fade * max(len(rallies) - 1, 0) + last


def camera_at(name: CameraName, path: BallPath, time: float) -> Camera:
    """Return the camera at ``time`` [s]."""
    camera = CAMERAS[name]
    if name != "follow":
        return camera
    near = np.linspace(time - _FOLLOWS_WITHIN_S, time + _FOLLOWS_WITHIN_S, 21)
    x, y, z = np.mean([position_at(path, float(t)) for t in near], axis=0)
    return replace(
        camera, look_at=(float(np.clip(x, -1.7, 1.4)), float(np.clip(y, -0.8, 0.8)), max(float(z), -0.1))
    )


def caption_at(rallies: Sequence[RecordedRally], number: int, time: float, options: FilmOptions) -> Caption:
    """Return the text on rally ``number``'s picture at ``time`` [s]."""
    rally = rallies[number]
    k = int(np.searchsorted(rally.time, time + 1e-9)) - 1
    speed, rate = np.linalg.norm(rally.ball_vel[k]), np.linalg.norm(rally.ball_spin[k])
    # the landing decides a return: the ball flies on after it
    is_over = k == len(rally.time) - 1 or rally.state[k] == 3
    verdict = ""
    if is_over:
        verdict = OUTCOME_WORDS[rally.outcome]
        if np.isfinite(rally.landing_error):
            verdict += f", {100 * rally.landing_error:.0f} cm from the target"
    speed_now = speed_at(rally, time, options)
    slow = f"{speed_now:g} x real time" if speed_now != 1.0 else ""
    return Caption(
        title=f"Rally {number + 1} of {len(rallies)}",
        lines=(
            f"ball {speed:.1f} m/s",
            f"spin {rate:.0f} rad/s, {spin_word(rally.ball_vel[k], rally.ball_spin[k])}",
        ),
        verdict=verdict,
        is_good=rally.outcome == Outcome.RETURNED,
        note="   ".join(part for part in (options.note, slow) if part),
    )


def pictures(
    rallies: Sequence[RecordedRally], options: FilmOptions, card: ScoreCard | None = None
) -> Iterator[Image]:
    """Yield a film's pictures (height, width, 3), one after the other, the score card last."""
    hold, fade = round(HOLD_S * options.rate_hz), round(FADE_S * options.rate_hz)
    lettering = Lettering(options.height)
    last: Image | None = None
    with Painter(options.width, options.height, rallies[0].robot) as painter:
        for number, rally in enumerate(rallies):
            path = path_of(rally)
            for index, time in enumerate(picture_times(rally, options)):
                picture = _picture(painter, rally, path, time, options)
                picture = lettering.write(picture, caption_at(rallies, number, time, options))
                if index == 0 and last is not None:
                    yield from _faded(last, picture, fade)
                yield picture
            for _ in range(hold):
                yield picture
            last = picture
            log.debug(
                "filmed rally=%d of=%d outcome=%s", number + 1, len(rallies), rally.outcome.name.lower()
            )
    if card is not None and last is not None:
        picture = lettering.write_card(last, card)
        yield from _faded(last, picture, fade)
        for _ in range(round(CARD_S * options.rate_hz)):
            yield picture


def _faded(before: Image, after: Image, count: int) -> Iterator[Image]:
    """Yield ``count`` pictures between two."""
    for k in range(count):
        share = (k + 1) / (count + 1)
        yield ((1.0 - share) * before + share * after).astype(np.uint8)


def _picture(
    painter: Painter, rally: RecordedRally, path: BallPath, time: float, options: FilmOptions
) -> Image:
    """Return one picture without words: the hall, with a close view of the ball in a corner."""
    moment = moment_at(rally, path, time)
    camera = camera_at(options.camera, path, time)
    picture = painter.paint(moment, camera)
    width, height = (
        round(part * size) for part, size in zip(_INSET, (options.width, options.height), strict=True)
    )
    x, y, z = (float(part) for part in moment.ball_pos)
    near = replace(camera, look_at=(x, y, z), distance=_INSET_DISTANCE)
    inset = painter.paint(moment, near, width, height, shadows=False)
    margin, edge = round(options.height / 30), max(round(options.height / 360), 1)
    top, left = margin, options.width - margin - width
    picture[top - edge : top + height + edge, left - edge : left + width + edge] = 235
    picture[top : top + height, left : left + width] = inset
    return picture


def write_film(path: Path, frames: Iterable[Image], width: int, height: int, rate_hz: float) -> int:
    """Write pictures (height, width, 3) as an mp4 and return how many; the file appears when it is complete."""
    ffmpeg = wanted("imageio_ffmpeg")
    part = path.with_name(f".{path.stem}.part.mp4")
    count = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.touch()  # raises with the reason; of ffmpeg we would see a broken pipe
        with closing(_open_writer(ffmpeg, part, width, height, rate_hz)) as writer:
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
                count += 1
        os.replace(part, path)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or (str(error).splitlines() or [""])[0]
        raise RenderError(f"can't write {path}: {reason}") from None
    finally:
        if part.exists():  # missing_ok does not cover a folder that is a file
            part.unlink()
    return count


def _open_writer(ffmpeg: Any, path: Path, width: int, height: int, rate_hz: float) -> Any:
    writer = ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=rate_hz,
        codec="libx264",
        pix_fmt_out="yuv420p",  # what browsers and phones play
        quality=None,
        macro_block_size=2,
        output_params=["-crf", _QUALITY, "-preset", "medium", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    return writer


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
    progress = bar("filming", "pictures")

    def frames() -> Iterator[Image]:
        for picture in progress.track(pictures(rallies, options, card), count):
            on_tick()
            yield picture

    with progress:
        write_film(path, frames(), config.width, config.height, config.rate_hz)
