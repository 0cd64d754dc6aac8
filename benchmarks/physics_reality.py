"""Errors of the ball's physics on recorded balls: tracks of a ball gun, with and without spin.

    python -m benchmarks.physics_reality --json

Each track is fitted (launch, spin, drag and lift factor) on its samples before the bounce, and the rms of the residuals
is the fit's error. Then parts are held out. The flight is fitted on its first 60 % and predicts the landing. A fit on
all of the flight predicts the path after the bounce, on a nominal table that is not fitted. The same is done with
gravity and drag alone (``without_magnus``), with gravity alone (``without_air``), and with all of the air on the other
flight model. All figures are medians over tracks. Nothing is tuned to a track.
"""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from common.physics.constants import TABLE_FRICTION, TABLE_RESTITUTION0
from common.physics.flight import FULL, SIMPLE
from common.task.config import FlightName
from topspin.real2sim.fit.bounces import Bounce, touches
from topspin.real2sim.fit.fit_problem import Air, FitOptions
from topspin.real2sim.fit.identify import Fit, fit
from topspin.real2sim.fit.predict import predict, touch_down
from topspin.real2sim.formats.recordings import load_folder
from topspin.real2sim.formats.tracks import FEWEST_SAMPLES, Array, RecordingError, Recordings, Track

DATA: Final = Path("../shared/data/mpi_ball_gun")  # relative to the working directory
LABELS: Final = ("topspin", "backspin", "no_spin")
FIRST_PART: Final = 0.6  # [-] share of the flight before the bounce from which the landing is predicted
LONGEST: Final = 2.0  # [s] of a predicted flight
AFTER: Final = 0.1  # [s] after its bounce, in which a ball is compared
FLIGHTS: Final = {"simple": SIMPLE, "full": FULL}
TABLE: Final = np.array([TABLE_RESTITUTION0, TABLE_FRICTION])


@dataclass(frozen=True, slots=True)
class Result:
    """Errors of one track under one model [m]; nan where there is none."""

    label: str
    fit_rms: float  # of the samples before the bounce
    topspin: float  # [rad/s] of that fit, around the horizontal axis across the flight; negative: backspin
    lift_factor: float  # [-] of that fit
    landing: float  # distance of the landing from its prediction by a fit on the first part of the flight
    landing_at_time: float  # distance of the bounce from that ball's position at the moment of the bounce
    after: float  # rms after the bounce of a ball that was fitted on the flight before it


def _distance(a: Sequence[float] | Array, b: Array) -> float:
    return float(np.linalg.norm(np.asarray(a) - b))


def _flown(launch: Array, table: Array, times: Array, flight: int) -> Array:
    """Return positions (n, 3) of a launch at times (n,) since it."""
    positions, velocities = np.empty((len(times), 3)), np.empty((len(times), 3))
    predict(launch, table, flight, times, positions, velocities)
    return positions


def _landing(track: Track, bounce: Bounce, options: FitOptions) -> tuple[float, float]:
    """Return the landing's two errors [m] of a fit on the first part of the flight."""
    first = int(np.searchsorted(track.times, FIRST_PART * bounce.time, side="right"))
    if first < FEWEST_SAMPLES:
        return np.nan, np.nan
    part = fit(Track(track.id, track.times[:first], track.positions[:first], track.label), options)
    moment, place, _ = touch_down(part.launch, options.flight, LONGEST)
    there = _flown(part.launch, np.empty(0), np.array([bounce.time]), options.flight)[0]
    planar = _distance(place[:2], bounce.position[:2]) if np.isfinite(moment) else np.nan
    return planar, _distance(there, bounce.position)


def _after(track: Track, bounce: Bounce, end: int, whole: Fit) -> float:
    """Return the rms [m] of the samples after the bounce. None of them was fitted."""
    rows = np.arange(bounce.first_after, end)
    rows = rows[track.times[rows] <= bounce.time + AFTER]
    if not len(rows):
        return np.nan
    there = _flown(whole.launch, TABLE, track.times[rows], whole.options.flight)
    return float(np.sqrt(np.mean(np.sum((there - track.positions[rows]) ** 2, axis=1))))


def result_of(track: Track, air: Air, flight: int) -> Result:
    """Return the errors of a track under a model. Raises RecordingError if it is too short."""
    options = FitOptions(air=air, flight=flight, through_bounce=False)
    found = touches(track)
    whole = fit(track, options)
    heading = whole.velocity / np.linalg.norm(whole.velocity[:2])
    across = np.array([-heading[1], heading[0], 0.0])  # z x heading: topspin is along it
    landing = at_time = after = np.nan
    if found.bounces and found.bounces[0].measured:
        bounce = found.bounces[0]
        end = found.bounces[1].first_after if len(found.bounces) > 1 else found.end
        landing, at_time = _landing(track, bounce, options)
        after = _after(track, bounce, end, whole)
    return Result(
        track.label or "unlabelled",
        whole.rms,
        float(whole.spin @ across),
        whole.lift_factor,
        landing,
        at_time,
        after,
    )


def _median(values: Sequence[float], digits: int = 2, percentile: float = 50.0) -> float | None:
    """Return a percentile of the finite values; None if there are none."""
    known = [value for value in values if np.isfinite(value)]
    return round(float(np.percentile(known, percentile)), digits) if known else None


def figures(results: Sequence[Result]) -> dict[str, Any]:
    """Return one model's figures by name."""
    by = {label: [result for result in results if result.label == label] for label in LABELS}
    found: dict[str, Any] = {
        f"fit_rms_mm_{label}": _median([1e3 * result.fit_rms for result in by[label]]) for label in LABELS
    }
    for name, values in (
        ("bounce_prediction_mm", [1e3 * result.landing for result in results]),
        ("bounce_prediction_at_time_mm", [1e3 * result.landing_at_time for result in results]),
        ("after_bounce_mm", [1e3 * result.after for result in results]),
    ):
        found[f"{name}_median"] = _median(values)
        found[f"{name}_p90"] = _median(values, percentile=90.0)
    for label in LABELS:
        found[f"bounce_prediction_mm_{label}"] = _median([1e3 * result.landing for result in by[label]])
        found[f"after_bounce_mm_{label}"] = _median([1e3 * result.after for result in by[label]])
        found[f"topspin_rad_s_{label}"] = _median([result.topspin for result in by[label]], 1)
        found[f"lift_factor_{label}"] = _median([result.lift_factor for result in by[label]])
    return found


def measure(recordings: Sequence[Recordings], flight: str) -> dict[str, Any]:
    """Return all figures, ready for JSON."""
    started = time.perf_counter()
    tracks: list[Track] = []
    dropped: dict[str, int] = {}
    for recording in recordings:
        for reason, count in recording.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
        for track in recording.tracks:
            found = touches(track)
            if (found.bounces[0].first_after if found.bounces else found.end) < FEWEST_SAMPLES:
                dropped["track too short before it touches anything"] = (
                    dropped.get("track too short before it touches anything", 0) + 1
                )
            else:
                tracks.append(track)
    if not tracks:
        raise RecordingError(f"no usable track ({dropped or 'the files hold none'})")
    other = next(name for name in FLIGHTS if name != flight)
    models = {
        "": (Air.ALL, flight),
        "without_magnus": (Air.DRAG, flight),
        "without_air": (Air.NONE, flight),
        f"flight_{other}": (Air.ALL, other),
    }
    found_by = {
        name: figures([result_of(track, air, FLIGHTS[model]) for track in tracks])
        for name, (air, model) in models.items()
    }
    bounces = [touches(track).bounces for track in tracks]
    return {
        **found_by.pop(""),
        **found_by,
        "flight": flight,
        "tracks": {label: sum(track.label == label for track in tracks) for label in LABELS},
        "unlabelled": sum(track.label not in LABELS for track in tracks),
        "bounces": sum(bool(found) for found in bounces),
        "bounces_measured": sum(bool(found) and found[0].measured for found in bounces),
        "bounce_height_mm": _median([1e3 * found[0].position[2] for found in bounces if found]),
        "dropped": dropped,
        "seconds": round(time.perf_counter() - started, 2),
    }


class PhysicsRealityConfig(BenchmarkConfig):
    """Fit recorded tracks through the project's physics, and predict the parts that are held out."""

    data: Path = Field(DATA, description="folder with *.hdf5 files of a ball gun")
    flight: FlightName = Field("simple", description="aerodynamics of the ball")


def main(config: PhysicsRealityConfig, _stop: Event) -> int:
    """Measure and print."""
    found = measure(load_folder(config.data, "*.hdf5"), config.flight)
    if config.json_line:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:>36}  {value}")
    return 0


if __name__ == "__main__":
    sys.exit(run("physics_reality", PhysicsRealityConfig, main))
