"""Whether the sigmas of fitted spins are honest: fits of simulated tracks, whose spin is known.

    python -m benchmarks.spin_sigma --json

Balls of a launch preset fly in drawn air (``randomization.air_factors``) and bounce on drawn tables. A camera with
position noise sees them until 0.15 s after the bounce, or until the bounce. Each track is fitted. The share of spins
within two sigmas of the truth must be near 0.95, the share within 95 % intervals too.
"""

import json
import sys
import time
from threading import Event
from typing import Any, Final

import numpy as np
from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from common.task.config import FlightName, PresetName, Randomization, TaskConfig
from common.task.launch import SPIN, VELOCITY, draw_rallies
from common.task.randomization import PROFILES, table_of
from topspin.real2sim.fit.fit_problem import FLOWN, FitOptions
from topspin.real2sim.fit.identify import fit
from topspin.real2sim.fit.predict import predict, touch_down
from topspin.real2sim.formats.tracks import FEWEST_SAMPLES, Array, Track

CASES: Final[dict[str, tuple[PresetName, bool]]] = {
    "mild_through_bounce": ("paper", True),
    "mild_before_bounce": ("paper", False),
    "strong_through_bounce": ("strong", True),
    "strong_before_bounce": ("strong", False),
}
AFTER: Final = 0.15  # [s] after the bounce, as long as a track through it is
LONGEST: Final = 2.0  # [s] of a flight to the bounce


def tracks_of(
    preset: PresetName, has_bounce: bool, config: "SpinSigmaConfig", model: int
) -> list[tuple[Track, Array]]:
    """Return simulated tracks, each with its launch (11,)."""
    task = TaskConfig(launch=preset, randomization=config.randomization, flight=config.flight)
    block = draw_rallies(config.tracks, task, seed=config.seed)
    rng = np.random.default_rng(config.seed)
    found: list[tuple[Track, Array]] = []
    for k, (launch, seed) in enumerate(zip(block.launches[:, :FLOWN], block.seeds, strict=True)):
        bounce, _, _ = touch_down(launch, model, LONGEST)
        duration = bounce + AFTER if has_bounce else bounce - 0.5 / config.rate_hz
        times = np.arange(0.0, duration, 1.0 / config.rate_hz)
        if len(times) < FEWEST_SAMPLES:
            continue
        positions = np.empty((len(times), 3))
        table = np.array(table_of(PROFILES[config.randomization], seed))
        predict(launch, table, model, times, positions, np.empty_like(positions))
        positions += 1e-3 * config.noise_mm * rng.standard_normal(positions.shape)
        stamps = times + 1e-3 * config.jitter_ms * rng.standard_normal(len(times))
        stamps[0] = 0.0
        found.append((Track(f"{preset}/{k}", stamps, positions), launch))
    return found


def shares(preset: PresetName, has_bounce: bool, config: "SpinSigmaConfig") -> dict[str, Any]:
    """Return the figures of one case, ready for JSON."""
    model = int(TaskConfig(flight=config.flight).flight_model)
    within, inside, along, sigmas, ratios = [], [], [], [], []
    started = time.perf_counter()
    made = tracks_of(preset, has_bounce, config, model)
    for track, launch in made:
        found = fit(track, FitOptions(flight=model, through_bounce=has_bounce))
        error = found.spin - launch[SPIN]
        within.append(np.abs(error) <= 2.0 * found.sigmas[SPIN])
        inside.append((found.spin_interval[0] <= launch[SPIN]) & (launch[SPIN] <= found.spin_interval[1]))
        flight = launch[VELOCITY] / np.linalg.norm(launch[VELOCITY])
        spread = found.covariance[SPIN, SPIN]
        along.append(abs(error @ flight) <= 2.0 * np.sqrt(flight @ spread @ flight))
        sigmas.append(found.sigmas[SPIN])
        ratios.append(np.linalg.norm(found.spin) / np.linalg.norm(launch[SPIN]))
    return {
        "tracks": len(made),
        "within_2_sigma": round(float(np.mean(within)), 3),
        "within_2_sigma_by_axis": [round(float(share), 3) for share in np.mean(within, axis=0)],
        "within_2_sigma_along_flight": round(float(np.mean(along)), 3),
        "within_95_interval": round(float(np.mean(inside)), 3),
        "sigma_median_rad_s": [round(float(value), 1) for value in np.median(sigmas, axis=0)],
        "rate_over_truth_median": round(float(np.median(ratios)), 3),
        "seconds_per_track": round((time.perf_counter() - started) / max(len(made), 1), 3),
    }


class SpinSigmaConfig(BenchmarkConfig):
    """Compare the sigmas of fitted spins with the errors, on simulated tracks."""

    tracks: int = Field(120, ge=10, description="tracks of each case")
    noise_mm: float = Field(
        2.0, gt=0, description="noise of a sample and axis", json_schema_extra={"unit": "mm"}
    )
    jitter_ms: float = Field(0.0, ge=0, description="noise of a time stamp", json_schema_extra={"unit": "ms"})
    rate_hz: float = Field(180.0, ge=20, description="rate of the camera", json_schema_extra={"unit": "Hz"})
    flight: FlightName = Field("full", description="aerodynamics of the ball, and of the fit")
    randomization: Randomization = Field("standard", description="profile of air and table")
    seed: int = Field(0, ge=0, lt=2**63, description="of balls and noise")


def main(config: SpinSigmaConfig, _stop: Event) -> int:
    """Measure and print."""
    found = {name: shares(preset, has_bounce, config) for name, (preset, has_bounce) in CASES.items()}
    if config.json_line:
        about = {"noise_mm": config.noise_mm, "rate_hz": config.rate_hz, "flight": config.flight}
        print(json.dumps(about | found))
    else:
        for name, row in found.items():
            print(name, *(f"{key} {value}" for key, value in row.items()), sep="  ")
    return 0


if __name__ == "__main__":
    sys.exit(run("spin_sigma", SpinSigmaConfig, main))
