"""The measures as a person reads them."""

from common.evaluation.printed import summary
from tests.unit.evaluation.played import RATES_AND_ERRORS

FOUND = RATES_AND_ERRORS | {
    "policy": "runs/night/policy/best",
    "end_to_end": False,
    "expected_spin": "learnt",
    "rallies": 2000,
    "launch": "strong",
    "randomization": "standard",
    "flight": "full",
    "collision": "tailored",
    "perception": "cheap",
    "seed": 20260,
    "rounds": 1,
    "catch_rate": 0.9975,
    "catch_rate_ci": [0.9942, 0.9989],
    "return_after_catch": 0.8195,
    "return_after_catch_ci": [0.802, 0.8358],
    "outcomes": {"returned": 1635, "net": 65, "out": 300},
    "robot": {
        "name": "rails",
        "self_penetration_share": 0.0005,
        "speed_over_limit_max": 0.9213,
        "table_strike_share": 0.002,
        "racket_speed_m_per_s": {"p50": 2.37, "p99": 3.5, "max": 4.01},
        "rim_hit_share": 0.013,
    },
    "seconds": 12.34,
}


def test_every_measure_has_its_unit_and_its_interval():
    assert summary(FOUND) == [
        ("policy", "runs/night/policy/best, not end-to-end, expected spin learnt"),
        (
            "balls",
            "2,000 strong, randomization standard, air full, contacts tailored, perception cheap, seed 20260",
        ),
        ("caught", " 99.8 %  (99.4 to 99.9)"),
        ("over the net", " 90.0 %  (88.6 to 91.2)"),
        ("returned", " 81.8 %  (80.0 to 83.4)"),
        ("after a catch", " 82.0 %  (80.2 to 83.6)"),
        (
            "landing error",
            "0.281 m  (0.273 to 0.289), median 0.249 m; 38.0 % within 0.2 m, 61.1 % within 0.3 m",
        ),
        ("how they ended", "returned 1,635, net 65, out 300"),
        (
            "robot",
            "rails: racket at the hit 2.4 m/s (median), at most 4.0 m/s; fastest joint at 0.92 of its limit",
        ),
        ("its faults", "strikes on the table 0.2 %, in itself 0.1 %, hits on the rim 1.3 %"),
        ("took", "12.3 s"),
    ]


def test_a_policy_that_hits_nothing_has_dashes():
    nothing = {
        "return_after_catch": None,
        "return_after_catch_ci": [0.0, 1.0],
        "target_error_mean": None,
        "target_error_mean_ci": None,
        "target_error_median": None,
        "outcomes": {"miss": 2000},
        "robot": FOUND["robot"]
        | {"racket_speed_m_per_s": {"p50": None, "p99": None, "max": None}, "rim_hit_share": None},
    }

    lines = dict(summary(FOUND | nothing))

    assert (lines["after a catch"], lines["landing error"]) == ("-", "-")
    assert lines["robot"] == "rails: no hit; fastest joint at 0.92 of its limit"
    assert lines["its faults"].endswith("hits on the rim -")


def test_rallies_in_a_row_say_how_many_come_how_far():
    row = {
        "rounds": 3,
        "rally_length_mean": 1.9,
        "by_round": [{"survival": 0.8}, {"survival": 0.6}, {"survival": 0.5}],
    }

    assert (
        "rallies",
        "1.90 balls returned in the mean; in a row 1: 80.0 %, 2: 60.0 %, 3: 50.0 %",
    ) in summary(FOUND | row)
