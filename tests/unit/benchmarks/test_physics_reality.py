"""The benchmark of the ball's physics on recordings that our own physics made: it must find almost no error."""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.physics_reality import LABELS, measure
from common.physics.flight import SIMPLE
from tests.unit.topspin.real2sim.flights import launch_of, seen
from topspin.real2sim.formats.tracks import RecordingError, Recordings, States, Track

SPINS = {"topspin": (0.0, -45.0, 0.0), "backspin": (0.0, 45.0, 0.0), "no_spin": (0.0, 0.0, 0.0)}


def recordings(duration=0.7):
    tracks = [
        Track(f"{label}/{k}", track.times, track.positions, label)
        for label in LABELS
        for k in range(2)
        for track in [
            seen(
                launch_of(spin=SPINS[label]),
                duration,
                noise=1e-3,
                jitter=0.35e-3,
                seed=k + 2 * len(label),
                flight=SIMPLE,
            )
        ]
    ]
    return [Recordings("made", tuple(tracks), States.none(), {"a reason": 2})]


def test_the_errors_on_our_own_balls_are_the_cameras_noise():
    found = measure(recordings(), "simple")

    assert found["tracks"] == dict.fromkeys(LABELS, 2)
    assert (found["bounces"], found["bounces_measured"], found["dropped"]) == (6, 6, {"a reason": 2})
    for label in LABELS:
        # 3-D noise: 1 mm in three axes, and 0.35 ms at 5 m/s
        assert found[f"fit_rms_mm_{label}"] == pytest.approx(np.hypot(np.sqrt(3.0), 0.35 * 5.0), rel=0.2)
    assert found["bounce_prediction_mm_median"] < 12.0
    assert found["after_bounce_mm_median"] < 8.0
    # a flight alone hides the rate of 45 rad/s: with a smaller lift factor, faster spin saturates at the same lift
    assert 20.0 < found["topspin_rad_s_topspin"] < 150.0
    assert -150.0 < found["topspin_rad_s_backspin"] < -20.0
    for less, more in (("without_air", "without_magnus"), ("without_magnus", None)):
        better = found[more] if more else found
        assert found[less]["fit_rms_mm_topspin"] > 2.0 * better["fit_rms_mm_topspin"]


def test_figures_that_no_track_shows_are_null():
    found = measure(recordings(duration=0.4), "simple")

    assert (found["bounces"], found["bounce_prediction_mm_median"], found["after_bounce_mm_p90"]) == (
        0,
        None,
        None,
    )
    assert json.loads(json.dumps(found)) == found


def test_recordings_without_a_usable_track_are_an_error():
    with pytest.raises(RecordingError, match=r"no usable track \(the files hold none\)"):
        measure([Recordings("made", (), States.none(), {})], "simple")


def test_a_missing_folder_is_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.physics_reality", "--json", "--data", str(tmp_path / "none")],
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.strip().splitlines() == [
        f"python -m benchmarks.physics_reality: {tmp_path / 'none'}: no such folder"
    ]
