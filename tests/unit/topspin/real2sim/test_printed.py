"""What a person reads of recorded balls."""

from tests.unit.evaluation.played import RATES_AND_ERRORS
from topspin.real2sim.printed import summary

FOUND = RATES_AND_ERRORS | {
    "policy": "runs/night/policy/best",
    "expected_spin": "mild",
    "opponents": 38,
    "data": "recordings",
    "recordings": 1352,
    "invalid": {"touches the net": 1},
    "dropped": {},
    "skipped": {"a.csv": "no column t", "b.csv": "empty"},
    "mode": "launch",
    "randomization": "standard",
    "perception": "full",
    "seed": 3,
    "rallies": 1351,
    "catch_rate": 1.0,
    "catch_rate_ci": [0.9966, 1.0],
    "return_after_catch": 0.8175,
    "return_after_catch_ci": [0.8, 0.8338],
    "outcomes": {"returned": 1105, "net": 246},
    "seconds": 12.34,
}
FITS = {
    "tracks_fitted": 40,
    "samples": 4477,
    "used_samples": 4470,
    "fit_rms_median": 0.00271,
    "fit_rms_p90": 0.00434,
    "noise_median": 0.00093,
    "spin_sigma_median": [3.2, 8.6, 1.3],
}


def test_what_was_left_out_and_what_was_measured_have_their_units():
    assert summary(FOUND) == [
        ("policy", "runs/night/policy/best, expected spin mild"),
        ("recordings", "1,352 of recordings"),
        ("not valid", "1: touches the net"),
        ("skipped files", "a.csv: no column t; b.csv: empty"),
        ("played", "1,351 balls, mode launch, randomization standard, perception full, seed 3"),
        ("caught", "100.0 %  (99.7 to 100.0)"),
        ("over the net", " 90.0 %  (88.6 to 91.2)"),
        ("returned", " 81.8 %  (80.0 to 83.4)"),
        ("after a catch", " 81.8 %  (80.0 to 83.4)"),
        (
            "landing error",
            "0.281 m  (0.273 to 0.289), median 0.249 m; 38.0 % within 0.2 m, 61.1 % within 0.3 m",
        ),
        ("how they ended", "returned 1,105, net 246"),
        ("took", "12.3 s"),
    ]


def test_tracks_show_how_far_their_fits_are():
    lines = dict(summary(FOUND | FITS))

    assert lines["fits"] == (
        "40 tracks, 4,470 of 4,477 samples; they are 2.7 mm away in the median, 4.3 mm in nine of ten"
    )
    assert lines["sigma"] == "0.9 mm of a sample, 3.2, 8.6, 1.3 rad/s of the spin in x, y, z (medians)"


def test_who_learns_from_ball_to_ball_met_so_many_opponents():
    assert dict(summary(FOUND | {"expected_spin": "learnt"}))["policy"].endswith("learnt, opponents 38")


def test_files_that_were_written_are_named():
    lines = summary(FOUND | {"video": "out/rallies.mp4", "report": "out/report.md"})

    assert ("video", "out/rallies.mp4") in lines
    assert ("report", "out/report.md") in lines
