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
from common.task.states import Outcome
from topspin.render.config import FilmConfig
from topspin.render.gl import Image, RenderError, wanted
from topspin.render.overlay import OUTCOME_WORDS, Caption, Lettering
from topspin.render.replay import BallPath, moment_at, path_of, position_at, spin_word
from topspin.render.scene import CAMERAS, Camera, CameraName, Painter

log = logging.getLogger(__name__)

HOLD_S: Final = 0.8  # the last picture of a rally is held, so that its text can be read
FADE_S: Final = 0.12  # from one rally into the next
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
    camera: CameraName = "side"
    note: str = ""  # written on every picture


def check_tools() -> None:
    """Raise RenderError if this machine can't make a film; called before the rallies are played."""
    for module in ("imageio_ffmpeg", "PIL.Image"):
        wanted(module)
    with Painter(64, 64):
        pass


def picture_times(rally: RecordedRally, options: FilmOptions) -> list[float]:
    """Return the times [s] since launch of a rally's moving pictures; the last is its end."""
    end, step = float(rally.time[-1]), options.slow / options.rate_hz
    return [k * step for k in range(int(end / step - 1e-9) + 1)] + [end]


def picture_count(rallies: Sequence[RecordedRally], options: FilmOptions) -> int:
    """Return how many pictures ``pictures`` makes of ``rallies``."""
    moving = sum(len(picture_times(rally, options)) for rally in rallies)
    hold, fade = round(HOLD_S * options.rate_hz), round(FADE_S * options.rate_hz)
    return moving + hold * len(rallies) + fade * max(len(rallies) - 1, 0)


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
    slow = f"{options.slow:g} x real time" if options.slow != 1.0 else ""
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


def pictures(rallies: Sequence[RecordedRally], options: FilmOptions) -> Iterator[Image]:
    """Yield a film's pictures (height, width, 3), one after the other."""
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
                    for k in range(fade):
                        share = (k + 1) / (fade + 1)
                        yield ((1.0 - share) * last + share * picture).astype(np.uint8)
                yield picture
            for _ in range(hold):
                yield picture
            last = picture
            log.info("filmed rally=%d of=%d outcome=%s", number + 1, len(rallies), rally.outcome.name.lower())


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
) -> None:
    """Write the film of ``rallies`` with ``note`` in its pictures; ``on_tick`` is called between pictures."""
    options = FilmOptions(config.width, config.height, config.rate_hz, config.slow, config.camera, note=note)
    log.info("filming rallies=%d pictures=%d file=%s", len(rallies), picture_count(rallies, options), path)

    def frames() -> Iterator[Image]:
        for picture in pictures(rallies, options):
            on_tick()
            yield picture

    write_film(path, frames(), config.width, config.height, config.rate_hz)
