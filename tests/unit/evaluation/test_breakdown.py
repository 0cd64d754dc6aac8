"""The measures by kind of ball, against counts by hand and a slow obvious reference."""

import json

import numpy as np
import pytest

from common.evaluation.breakdown import (
    BREAKDOWNS,
    SPIN_KINDS,
    breakdown,
    on_grid,
    spin_kinds,
    survival,
)
from common.evaluation.measures import wilson
from common.evaluation.printed import table
from common.task.states import Outcome
from tests.unit.evaluation.played import MISSED, NAN, OUT, RETURNED, make_played, random_played


def slowly(value, edges, names, without):
    """Return the bin of one value, by a check of each."""
    if np.isnan(value):
        return without
    return next(name for name, low, high in zip(names, edges, edges[1:], strict=False) if low <= value < high)


@pytest.mark.parametrize(
    ("key", "edges", "value"),
    [
        (
            "speed",
            (-np.inf, 4, 5, 6, 7, 8, 10, 13, 16, np.inf),
            lambda p, k: np.linalg.norm(p.launches[k, 3:6]),
        ),
        (
            "spin",
            (-np.inf, 40, 60, 80, 100, 150, 200, 250, 300, 450, 600, np.inf),
            lambda p, k: np.linalg.norm(p.launches[k, 6:9]),
        ),
        (
            "arrival_y",
            (-np.inf, -0.9, -0.6, -0.3, 0, 0.3, 0.6, 0.9, np.inf),
            lambda p, k: p.arrivals[k, 1],
        ),
        ("arrival_height", (-np.inf, 0, 0.1, 0.2, 0.3, 0.4, np.inf), lambda p, k: p.arrivals[k, 2]),
    ],
)
def test_rates_by_kind_equal_counts_rally_by_rally(key, edges, value):
    played = random_played(400)
    names = BREAKDOWNS[key].bins
    counted = {}
    for k in range(400):
        found = counted.setdefault(slowly(value(played, k), edges, names, "never"), [])
        found.append((played.caught[k], played.outcomes[k] == Outcome.RETURNED, played.landing_errors[k]))

    entries = breakdown(played)[key]

    assert [entry["bin"] for entry in entries] == [name for name in names if name in counted]
    for entry in entries:
        rallies = counted[entry["bin"]]
        caught, returned = sum(c for c, _, _ in rallies), sum(r for _, r, _ in rallies)
        assert entry["rallies"] == len(rallies)
        assert entry["catch_rate"] == round(caught / len(rallies), 4)
        assert entry["return_rate"] == round(returned / len(rallies), 4)
        assert entry["return_rate_ci"] == [round(bound, 4) for bound in wilson(returned, len(rallies))]
        assert entry["return_after_catch"] == (round(returned / caught, 4) if caught else None)
        mean = np.mean([error for _, r, error in rallies if r]) if returned else None
        assert entry["target_error_mean"] == pytest.approx(mean, abs=6e-5)


def test_every_rally_is_in_one_bin_of_every_breakdown():
    played = random_played(300, seed=1)

    assert {key: sum(entry["rallies"] for entry in bins) for key, bins in breakdown(played).items()} == (
        dict.fromkeys(BREAKDOWNS, 300)
    )


@pytest.mark.parametrize(
    ("velocity", "spin", "kind"),
    [
        ((-5, 0, 0), (0, -80, 0), "topspin"),  # its top moves towards the robot
        ((-5, 0, 0), (0, 80, 0), "backspin"),
        ((-5, 0, 0), (0, 20, -80), "sidespin"),
        ((-5, 0, 0), (80, 20, 0), "corkscrew"),
        ((-3, 3, 0), (-50, -50, 0), "topspin"),  # about the flight's own right
        ((-3, 3, 2), (50, -50, 0), "corkscrew"),
        ((-5, 0, 0), (0, -15, 0), "under 20 rad/s"),
    ],
)
def test_a_spin_has_the_name_of_its_largest_part(velocity, spin, kind):
    played = make_played([MISSED], launches=[[1, 0, 0.3, *velocity, *spin, 1, 1]])

    assert SPIN_KINDS[spin_kinds(played)[0]] == kind


def test_the_top_of_a_topspin_ball_moves_forward():
    played = random_played(200, seed=2)
    top = np.cross(
        played.launches[:, 6:9], (0.0, 0.0, 1.0)
    )  # velocity of the ball's top about its centre / r
    forward = (top[:, :2] * played.launches[:, 3:5]).sum(axis=1)
    kinds = np.array(SPIN_KINDS)[spin_kinds(played)]

    assert (kinds == "topspin").sum() > 20
    assert (forward[kinds == "topspin"] > 0).all()
    assert (forward[kinds == "backspin"] < 0).all()


@pytest.mark.parametrize(
    ("target", "name"),
    [((0.2, -0.7), "short right"), ((0.7, 0.0), "middle centre"), ((1.35, 0.7), "deep left")],
)
def test_targets_are_named_from_the_robots_side(target, name):
    played = make_played([RETURNED], targets=[target])

    assert breakdown(played)["target"][0]["bin"] == name


def test_survival_is_the_product_of_the_rounds_rates_and_its_sum_the_length():
    rows = [RETURNED, RETURNED, OUT, MISSED, RETURNED, OUT]
    found = survival(make_played(rows, rounds=np.array([1, 1, 1, 1, 2, 2], np.int32)))

    assert [(r["round"], r["rallies"], r["return_rate"], r["survival"]) for r in found["by_round"]] == [
        (1, 4, 0.5, 0.5),
        (2, 2, 0.5, 0.25),
    ]
    assert found["by_round"][0]["return_rate_ci"] == [round(bound, 4) for bound in wilson(2, 4)]
    assert found["rally_length_mean"] == 0.75
    assert found["rally_length_median"] == 1  # half of the rallies have one ball or more, a quarter two


def test_a_round_that_the_sets_end_cuts_does_not_shorten_rallies():
    """The two returned first balls whose second ball is not in the set do not count in round 2."""
    rows = [RETURNED, RETURNED, RETURNED, OUT, RETURNED]
    found = survival(make_played(rows, rounds=np.array([1, 1, 1, 1, 2], np.int32)))

    assert found["rally_length_mean"] == 0.75 + 0.75


def test_a_grid_holds_means_and_counts_of_its_cells():
    edges = (np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]))
    points = np.array([[0.5, 0.5], [0.6, 0.5], [1.5, 0.5], [5.0, 0.5], [NAN, 0.5], [0.1, 0.1]])
    mean, count = on_grid(points, np.array([1.0, 3.0, NAN, 9.0, 9.0, 5.0]), edges)

    np.testing.assert_array_equal(count, [[3], [0]])
    np.testing.assert_array_equal(mean, [[3.0], [NAN]])


def test_breakdowns_are_json_and_lines_of_text():
    found = breakdown(make_played([RETURNED, MISSED]))
    lines = table(found)

    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert "                                  5 to 6        2  50.0 %    50.0 %      100.0 %  0.20 m" in lines
