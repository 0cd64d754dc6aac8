"""Files of recordings as rallies to play, with counts of what was left out."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from common.physics.flight_model import Flight
from common.task.launch import SPIN
from topspin.real2sim import replay
from topspin.real2sim.config import Real2SimConfig
from topspin.real2sim.formats.recordings import load, load_folder
from topspin.real2sim.formats.tracks import FEWEST_SAMPLES, RecordingError, Recordings, States, Track
from topspin.real2sim.kinematic import driven
from topspin.real2sim.replay import RecordedRallies

if TYPE_CHECKING:  # the fit needs scipy, an extra; states do not
    from topspin.real2sim.fit.identify import Fit

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

log = logging.getLogger(__name__)

PROGRESS_EVERY_S: Final = 5.0  # [s] between two lines of progress

FIRST_PART: Final = 0.05  # [s] of a track, which shows where it flies

SAME_NAME: Final = "recording with the name of another"
TRACK_AWAY: Final = "track that flies away from the robot"
TOO_SHORT: Final = "track with too few samples before the ball touches anything"
NO_TRACK: Final = "state, which has no track to drive the ball"


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recordings that fly towards the robot, as rallies.

    Attributes:
        rallies: One row each, states first.
        tracks: The track of each row; None for a state.
        fits: The fit of each row; None for a state.
        dropped: How many samples and recordings were left out, by reason.
        skipped: Files that could not be used, and why, by name.
    """

    rallies: RecordedRallies
    tracks: tuple[Track | None, ...]
    fits: tuple["Fit | None", ...]
    dropped: Mapping[str, int]
    skipped: Mapping[str, str]

    @property
    def fit_rms(self) -> Array:
        """Return the distance [m] between samples and fit (root of the mean square) (n,); nan for a state."""
        return np.array([float("nan") if one is None else one.rms for one in self.fits])

    def fit_summary(self) -> dict[str, Any]:
        """Return the errors of the fits, ready for JSON; {} without fits."""
        fits = [one for one in self.fits if one is not None]
        if not fits:
            return {}
        rms = [one.rms for one in fits]
        return {
            "tracks_fitted": len(fits),
            "samples": sum(one.samples for one in fits),
            "used_samples": sum(one.used_samples for one in fits),
            "fit_rms_median": round(float(np.median(rms)), 5),
            "fit_rms_p90": round(float(np.quantile(rms, 0.9)), 5),
            "noise_median": round(float(np.median([one.noise[0] for one in fits])), 5),
            "spin_sigma_median": [
                round(float(sigma), 1) for sigma in np.median([one.sigmas[SPIN] for one in fits], axis=0)
            ],
        }

    def opponents(self, are_remembered: bool) -> Integers:
        """Return the number of each valid rally's opponent (n,): one for each player, and for each unknown one.

        Args:
            are_remembered: Whether the robot learns from ball to ball. Otherwise each ball has its own opponent, which
                makes no difference.
        """
        players = [self.rallies.players[k] for k in np.flatnonzero(self.rallies.valid)]
        if not are_remembered:
            return np.arange(len(players), dtype=np.int64)
        names = [("player", player) if player else ("ball", k) for k, player in enumerate(players)]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        return np.array([numbers[name] for name in names], np.int64)


def read(config: Real2SimConfig, flight: Flight, on_tick: Callable[[], None] = lambda: None) -> Recorded:
    """Return the recordings that the settings name.

    Args:
        config: Which recordings, and how they are played.
        flight: Aerodynamics that tracks are fitted with.
        on_tick: Called between fits, so that the caller can do other work, or raise.

    Raises:
        RecordingError: A file can't be used, or nothing is left.
    """
    path = Path(config.data)
    skipped: dict[str, str] = {}
    if path.is_dir():
        files = load_folder(path, turn=config.turn, skipped=None if config.strict else skipped)
    else:
        files = (load(path, turn=config.turn),)
    for name, error in skipped.items():
        log.warning("skipped file=%s error=%s", name, error)
    dropped: Counter[str] = Counter()
    for found in files:
        dropped.update(found.dropped)
    states, tracks = _with_unique_names(files, dropped)
    if config.mode == "kinematic":
        if not tracks:
            raise RecordingError(
                f"{path}: got states only, for --mode kinematic; allowed: tracks, or --mode launch"
            )
        dropped.update({NO_TRACK: len(states)} if len(states) else {})
        states = States.none()
    coming = [track for track in tracks if _comes(track)]
    dropped.update({TRACK_AWAY: len(tracks) - len(coming)} if len(coming) < len(tracks) else {})
    chosen = evenly(len(states) + len(coming), config.rallies)
    n = len(states)
    recorded = _as_rallies(
        _rows(states, chosen[chosen < n]),
        [coming[k - n] for k in chosen[chosen >= n]],
        config,
        flight,
        dropped,
        on_tick,
    )
    return replace(recorded, skipped=skipped)


def _comes(track: Track) -> bool:
    """Return whether a track begins towards the robot; it may go on after the robot's stroke."""
    row = max(FEWEST_SAMPLES - 1, int(np.searchsorted(track.times, FIRST_PART)))
    row = min(row, len(track.times) - 1)
    return bool(track.positions[row, 0] < track.positions[0, 0])


def evenly(count: int, most: int) -> Integers:
    """Return at most ``most`` of ``count`` indices, spread evenly; all of them if ``most`` is 0."""
    taken = min(count, most) if most else count
    return np.arange(taken, dtype=np.int64) * count // max(taken, 1)


def _rows(states: States, rows: Integers) -> States:
    return States(
        tuple(states.ids[k] for k in rows),
        states.positions[rows],
        states.velocities[rows],
        states.spins[rows],
        tuple(states.labels[k] for k in rows),
        tuple(states.players[k] for k in rows),
    )


def _with_unique_names(files: Sequence[Recordings], dropped: Counter[str]) -> tuple[States, list[Track]]:
    """Return the states and tracks of all files; all names differ, because a rally's seed is drawn from its name.

    A name that an earlier file already has gets its own file's name as a prefix.
    """
    taken: set[str] = set()

    def free(name: str, source: str) -> str | None:
        for tried in (name, f"{Path(source).stem}/{name}"):
            if tried not in taken:
                taken.add(tried)
                return tried
        dropped[SAME_NAME] += 1
        return None

    parts, tracks = [], list[Track]()
    for found in files:
        names = [free(name, found.source) for name in found.states.ids]
        named = replace(found.states, ids=tuple(name or "" for name in names))
        parts.append(_rows(named, np.flatnonzero([name is not None for name in names])))
        for track in found.tracks:
            if (name := free(track.id, found.source)) is not None:
                tracks.append(replace(track, id=name))
    states = States(
        tuple(name for part in parts for name in part.ids),
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.velocities for part in parts]),
        np.concatenate([part.spins for part in parts]),
        tuple(label for part in parts for label in part.labels),
        tuple(player for part in parts for player in part.players),
    )
    return states, tracks


def _as_rallies(
    states: States,
    tracks: Sequence[Track],
    config: Real2SimConfig,
    flight: Flight,
    dropped: Counter[str],
    on_tick: Callable[[], None],
) -> Recorded:
    model = int(flight)
    parts: list[RecordedRallies] = []
    kept: list[Track | None] = [None] * len(states)
    kept_fits: list[Fit | None] = [None] * len(states)
    if len(states):
        # air "off": the air of the recording is unknown, and nominal is the best guess
        parts.append(
            replay.of_states(
                states, seed=config.seed, air="off", randomization=config.randomization, flight=model
            )
        )
    fitted, fits = _fitted(tracks, model, dropped, on_tick)
    if fits:
        labels, players = [track.label for track in fitted], [track.player for track in fitted]
        found = replay.of_fits(fits, labels, players, seed=config.seed, randomization=config.randomization)
        if config.mode == "kinematic":
            found = driven(found, fitted, fits, config.randomization)
        parts.append(found)
        kept += fitted
        kept_fits += fits
    if not parts:
        reasons = "; ".join(f"{reason}: {count}" for reason, count in dropped.items())
        raise RecordingError(f"{config.data}: no recording is left to play ({reasons or 'there is none'})")
    return Recorded(_joined(parts), tuple(kept), tuple(kept_fits), dict(dropped), {})


def _joined(parts: Sequence[RecordedRallies]) -> RecordedRallies:
    """Return rallies of several kinds as one. Only kinematic mode has paths, and there all are of one kind."""
    if len(parts) == 1:
        return parts[0]
    return RecordedRallies(
        tuple(name for part in parts for name in part.ids),
        tuple(label for part in parts for label in part.labels),
        np.concatenate([part.launches for part in parts]),
        np.concatenate([part.seeds for part in parts]),
        np.concatenate([part.touched for part in parts]),
        players=tuple(player for part in parts for player in part.players),
    )


def _fitted(
    tracks: Sequence[Track], model: int, dropped: Counter[str], on_tick: Callable[[], None]
) -> tuple[list[Track], list["Fit"]]:
    """Return the tracks that can be fitted, and their fits; logs its progress."""
    if not tracks:
        return [], []
    try:
        from topspin.real2sim.fit.fit_problem import FitOptions  # noqa: PLC0415 - scipy, an extra; states do not need it
        from topspin.real2sim.fit.identify import fit  # noqa: PLC0415 - the same
    except ImportError:
        raise RecordingError("fitting tracks needs scipy: pip install -e '.[real2sim]'") from None
    options = FitOptions(flight=model)
    kept, fits = list[Track](), list["Fit"]()
    said = started = time.monotonic()
    for k, track in enumerate(tracks):
        on_tick()
        try:
            fits.append(fit(track, options))
            kept.append(track)
        except RecordingError:
            dropped[TOO_SHORT] += 1
        now = time.monotonic()
        if now - said > PROGRESS_EVERY_S or k + 1 == len(tracks):
            said = now
            log.info("fitting done=%d of=%d seconds=%.0f", k + 1, len(tracks), now - started)
    return kept, fits
