"""Recordings as values, and the rules that accept, drop or refuse their samples.

Positions here are in the world frame and SI. The rules are the same for every format:

* A file that can't be read, or that makes no sense as a whole, is an error with file and line.
* A bad sample is dropped, a bad recording is dropped; each is counted under its reason.
* A file of which nothing is left is an error that lists the reasons.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.errors import ReportedError
from common.physics.flight import FULL, Air, acceleration
from common.physics.vec import vec_at

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

FEWEST_SAMPLES: Final = 8  # of a track; fewer give no information about spin
LONGEST_GAP: Final = 0.1  # s; after a longer gap another track begins
TIME_STEPS: Final = (5e-4, 0.06)  # s; median between samples: 2,000 Hz to 17 Hz
SPEEDS: Final = (0.3, 40.0)  # m/s; of a ball in play; the fastest recorded smash has 35
MAX_SPIN: Final = 2000.0  # rad/s; the fastest ball guns reach 1,200
ROOM: Final = ((-6.0, 6.0), (-4.0, 4.0), (-1.0, 4.0))  # m; limits of x, y and z of a sample
JUMP_SPEED: Final = 60.0  # m/s; a sample this fast from both neighbours is not the ball
JUMP_SLACK: Final = 0.05  # m; noise of position and of the time stamp
MOST_BAD: Final = 0.25  # [-] a recording of which a larger share of samples is bad is dropped


_ROOM_TEXT: Final = ", ".join(
    f"{axis} {low:g}..{high:g}" for axis, (low, high) in zip("xyz", ROOM, strict=True)
)
_OUTSIDE: Final = f"sample outside the room ({_ROOM_TEXT} m: check unit and frame)"


class RecordingError(ReportedError, ValueError):
    """A file of recordings that can't be used: one line with file, place, value and what is allowed."""


@dataclass(frozen=True, slots=True)
class Track:
    """One flight as a camera recorded it.

    Attributes:
        id: Name of the recording, unique in its file.
        times: (n,) [s], rising, from 0.
        positions: (n, 3) [m] of the ball's centre, world frame.
        label: Kind of ball (``topspin`` ...); empty if unknown.
        player: Who played the ball; empty if unknown.
    """

    id: str
    times: Array
    positions: Array
    label: str = ""
    player: str = ""


@dataclass(frozen=True, slots=True)
class States:
    """Balls just after a stroke, one row each, world frame.

    Attributes:
        ids: Names.
        positions: (n, 3) [m].
        velocities: (n, 3) [m/s].
        spins: (n, 3) [rad/s].
        labels: Kind of each ball; empty if unknown.
        players: Who played each ball; empty if unknown.
    """

    ids: tuple[str, ...]
    positions: Array
    velocities: Array
    spins: Array
    labels: tuple[str, ...]
    players: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def none() -> "States":
        """Return no states."""
        return States((), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), (), ())


@dataclass(frozen=True, slots=True)
class Recordings:
    """The content of a file.

    Attributes:
        source: The file's name.
        tracks: Recorded flights.
        states: Recorded states.
        dropped: Number of dropped samples and recordings, by reason.
    """

    source: str
    tracks: tuple[Track, ...]
    states: States
    dropped: Mapping[str, int]


def require_some(recordings: Recordings) -> Recordings:
    """Return the recordings; raises RecordingError if all were dropped."""
    if not recordings.tracks and not recordings.states.ids:
        reasons = "; ".join(f"{reason}: {count}" for reason, count in recordings.dropped.items())
        raise RecordingError(f"{recordings.source}: no recording is usable ({reasons or 'there is none'})")
    return recordings


def inside_room(positions: Array) -> Mask:
    """Return which positions (n, 3) [m] lie in the room (n,)."""
    low, high = np.array(ROOM).T
    inside: Mask = np.all((positions >= low) & (positions <= high), axis=1)
    return inside


def _without_jumps(times: Array, positions: Array) -> Mask:
    """Return which samples (n,) are within reach of a neighbour: False if far from both neighbours."""
    reach = JUMP_SPEED * np.diff(times) + JUMP_SLACK
    far = np.linalg.norm(np.diff(positions, axis=0), axis=1) > reach
    before, after = np.append(True, far), np.append(far, True)
    near: Mask = ~(before & after)
    return near


def _refused(times: Array, positions: Array) -> str:
    """Return why a cleaned track can't be a ball's, or an empty string."""
    if len(times) < FEWEST_SAMPLES:
        return f"recording with fewer than {FEWEST_SAMPLES} good samples"
    step = float(np.median(np.diff(times)))
    if not TIME_STEPS[0] <= step <= TIME_STEPS[1]:
        return f"recording with a time step outside {TIME_STEPS[0]:g}..{TIME_STEPS[1]:g} s"
    # over five samples: noise of 2 mm at 200 Hz would look like 0.5 m/s
    lag = min(5, len(times) - 1)
    speeds = np.linalg.norm(positions[lag:] - positions[:-lag], axis=1) / (times[lag:] - times[:-lag])
    if not SPEEDS[0] <= float(np.median(speeds)) <= SPEEDS[1]:
        return f"recording with a speed outside {SPEEDS[0]:g}..{SPEEDS[1]:g} m/s"
    return ""


def checked_tracks(
    name: str, times: Array, positions: Array, label: str, dropped: Counter[str], player: str = ""
) -> list[Track]:
    """Return the tracks of a recording: usually one, none if it is bad, several if it has long gaps.

    Args:
        name: The recording's id; the parts of a divided one get ``-1``, ``-2`` ...
        times: (n,) [s].
        positions: (n, 3) [m], world.
        label: Kind of ball.
        dropped: Reasons are counted into this.
        player: Who played the ball.
    """
    finite = np.isfinite(times) & np.isfinite(positions).all(axis=1)
    if len(times) and np.any(np.diff(times[finite]) < 0.0):
        dropped["recording whose time goes backwards"] += 1
        return []
    inside = finite.copy()
    inside[finite] = inside_room(positions[finite])
    good = inside.copy()
    good[np.flatnonzero(inside)[1:]] = np.diff(times[inside]) > 0.0
    once = good.copy()
    if good.sum() > 2:
        good[once] = _without_jumps(times[once], positions[once])
    bad = (
        ("sample that is not finite", len(times) - int(finite.sum())),
        (_OUTSIDE, int(finite.sum() - inside.sum())),
        ("sample at the time of another", int(inside.sum() - once.sum())),
        ("sample far from both neighbours", int(once.sum() - good.sum())),
    )
    if good.sum() < (1.0 - MOST_BAD) * len(times):
        worst, _ = max(bad, key=lambda reason: reason[1])
        dropped[f"recording with more than {MOST_BAD:.0%} bad samples, most of them: {worst}"] += 1
        return []
    dropped.update({reason: count for reason, count in bad if count})
    times, positions = times[good], positions[good]
    cuts = np.flatnonzero(np.diff(times) > LONGEST_GAP) + 1
    if len(cuts) and len(times) and np.median(np.diff(times)) < LONGEST_GAP:
        dropped[f"gap of more than {LONGEST_GAP:g} s, where a recording was divided"] += len(cuts)
    else:
        cuts = cuts[:0]  # every step is a gap: the unit of time is wrong, and the check below reports it
    tracks: list[Track] = []
    for part, (t, p) in enumerate(zip(np.split(times, cuts), np.split(positions, cuts), strict=True), 1):
        if reason := _refused(t, p):
            dropped[reason] += 1
            continue
        tracks.append(Track(name if not len(cuts) else f"{name}-{part}", t - t[0], p, label, player))
    return tracks


def _earlier(velocities: Array, spins: Array, delay: float) -> Array:
    """Return the velocities (n, 3) [m/s] that balls had ``delay`` seconds before they had these."""
    air = Air(1.0, 1.0, FULL)
    found = np.empty_like(velocities)
    for row, velocity, spin in zip(found, velocities, spins, strict=True):
        row[:] = velocity - delay * np.array(acceleration(vec_at(velocity, 0), vec_at(spin, 0), air))
    return found


def checked_states(
    ids: list[str],
    rows: Array,
    labels: list[str],
    dropped: Counter[str],
    turn: bool = False,
    players: Sequence[str] = (),
    velocity_delay: float = 0.0,
) -> States:
    """Return the states that fly towards the robot.

    Args:
        ids: n names.
        rows: (n, 9) position [m], velocity [m/s], spin [rad/s], world.
        labels: n labels.
        dropped: Reasons are counted into this.
        turn: Rotate states that fly towards the opponent by 180 degrees about z, instead of dropping them.
        players: n names; none: unknown.
        velocity_delay: Time [s] by which the moment of the velocities is later than that of the positions. The
            velocity at the position is then v - velocity_delay a(v, w), with the nominal air of the full model.
    """
    players = tuple(players) or ("",) * len(ids)
    rows = rows.copy()
    away = rows[:, 3] >= 0.0
    if turn:
        # a proper rotation: position, velocity and the axial spin are rotated alike
        rows[away] *= np.array([-1.0, -1.0, 1.0] * 3)
        away = rows[:, 3] >= 0.0
    speeds = np.linalg.norm(rows[:, 3:6], axis=1)
    keep = np.ones(len(rows), np.bool_)
    for reason, bad in (
        ("state that is not finite", ~np.isfinite(rows).all(axis=1)),
        (f"state outside the room ({_ROOM_TEXT} m: check unit and frame)", ~inside_room(rows[:, :3])),
        (
            f"state with a speed outside {SPEEDS[0]:g}..{SPEEDS[1]:g} m/s",
            ~((speeds >= SPEEDS[0]) & (speeds <= SPEEDS[1])),
        ),
        (f"state with a spin above {MAX_SPIN:g} rad/s", np.linalg.norm(rows[:, 6:9], axis=1) > MAX_SPIN),
        ("state that flies away from the robot", away),
    ):
        count = int((keep & bad).sum())
        if count:
            dropped[reason] += count
        keep &= ~bad
    kept = np.flatnonzero(keep)
    chosen = rows[kept]
    if velocity_delay:
        chosen[:, 3:6] = _earlier(chosen[:, 3:6], chosen[:, 6:9], velocity_delay)
    return States(
        tuple(ids[k] for k in kept),
        chosen[:, :3],
        chosen[:, 3:6],
        chosen[:, 6:9],
        tuple(labels[k] for k in kept),
        tuple(players[int(k)] for k in kept),
    )
