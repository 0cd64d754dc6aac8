"""Still pictures of one rally: the whole rally in one, and its four parts as a strip."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from common.evaluation.rally_recorder import RecordedRally
from common.task.states import Outcome
from topspin.render.film import camera_at
from topspin.render.gl import Image, RenderError, wanted
from topspin.render.overlay import Caption, Lettering
from topspin.render.replay import moment_at, path_of, spin_word
from topspin.render.scene import TRAIL, Camera, CameraName, Painter

Array = npt.NDArray[np.float64]

OVERSAMPLED: Final = (
    2  # pictures are drawn twice as large and then reduced: smoother than the graphics' own smoothing
)
_GHOSTS_BEFORE_HIT_S: Final = (0.40, 0.16)  # times at which the arm is drawn faintly
_AFTER_LANDING_S: Final = 0.16  # so that the last colour is visible
_STRIP_SHARE: Final = {
    0: 0.6,
    1: 1.0,
    2: 0.5,
    3: 0.25,
    4: 0.6,
}  # share of each part's duration at which the strip's picture is taken
_CLOSE: Final = 1.75  # [m] from the strip's camera to the ball
_GAP: Final = 8  # [pixels] between the strip's pictures


def showpiece(rallies: Sequence[RecordedRally]) -> RecordedRally:
    """Return the rally to show: the returned one that lands nearest to its target, or else the longest one."""
    returned = [rally for rally in rallies if rally.outcome == Outcome.RETURNED]
    if returned:
        return min(returned, key=lambda rally: rally.landing_error)
    return max(rallies, key=lambda rally: (len(part_times(rally)), len(rally.time)))


def part_times(rally: RecordedRally) -> dict[int, tuple[float, float]]:
    """Return the start and end [s] of each state that the rally reached, in the order of time."""
    times = {int(s): rally.time[rally.state == s] for s in np.unique(rally.state)}
    parts = [(float(time[0]), float(time[-1]), state) for state, time in times.items()]
    return {state: (start, end) for start, end, state in sorted(parts)}


def rally_picture(rally: RecordedRally, camera: CameraName, width: int, height: int) -> Image:
    """Return one picture (height, width, 3) of a whole rally: its trail, and the robot at the hit and before."""
    path = path_of(rally)
    parts, last = part_times(rally), float(rally.time[-1])
    hit = parts[2][0] if 2 in parts else last
    end = min(parts[3][0] + _AFTER_LANDING_S, last) if 3 in parts else last
    moment = replace(
        moment_at(rally, path, end),
        joints=moment_at(rally, path, hit).joints,
        ghosts=tuple(
            moment_at(rally, path, hit - early).joints for early in _GHOSTS_BEFORE_HIT_S if early < hit
        ),
    )
    speed, rate = np.linalg.norm(rally.ball_vel[0]), np.linalg.norm(rally.ball_spin[0])
    caption = Caption(
        title=f"Coming at {speed:.1f} m/s",
        lines=(f"spin {rate:.0f} rad/s, {spin_word(rally.ball_vel[0], rally.ball_spin[0])}",),
        verdict=f"lands {100 * rally.landing_error:.0f} cm from the target" if 3 in parts else "",
    )
    scale = OVERSAMPLED
    with Painter(width * scale, height * scale, rally.robot) as painter:
        picture = painter.paint(moment, camera_at(camera, path, end))
    return smaller(Lettering(height * scale).write(picture, caption), scale)


def rally_strip(rally: RecordedRally, width: int, height: int) -> Image:
    """Return the parts of a rally side by side, each (height, width, 3): (served,) coming, bounced, hit, landed."""
    path, scale = path_of(rally), OVERSAMPLED
    lettering = Lettering(3 * height * scale)
    parts = []
    with Painter(width * scale, height * scale, rally.robot) as painter:
        for state, (start, end) in part_times(rally).items():
            time = start + _STRIP_SHARE[state] * (end - start)
            picture = painter.paint(moment_at(rally, path, time), _close(camera_at("follow", path, time)))
            parts.append(
                smaller(lettering.write(picture, Caption(note=TRAIL[state].label, legend=False)), scale)
            )
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    return np.concatenate([piece for part in parts for piece in (part, gap)][:-1], axis=1)


def _close(camera: Camera) -> Camera:
    return replace(camera, distance=_CLOSE)


def smaller(picture: Image, scale: int) -> Image:
    """Return a picture ``scale`` times smaller, its pixels averaged."""
    height, width, _ = picture.shape
    blocks = picture.reshape(height // scale, scale, width // scale, scale, 3)
    averaged: Image = blocks.mean(axis=(1, 3)).round().astype(np.uint8)
    return averaged


def save_png(path: Path, picture: Image) -> None:
    """Write a picture as a PNG."""
    image = wanted("PIL.Image").fromarray(picture)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        image.save(path, optimize=True)
    except OSError as error:
        raise RenderError(f"can't write {path}: {error.strerror or error}") from None
