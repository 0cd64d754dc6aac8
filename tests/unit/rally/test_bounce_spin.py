"""The spin behind a bounce is Bayes' rule: balls drawn by the hundred thousand, bounced and weighed, say the same."""

from functools import cache

import numpy as np
import pytest

from common.physics.table_bounce import table_bounce
from common.rally.bounce_spin import (
    INNER,
    OUTER,
    POINTS,
    densities,
    quasi_random,
    shown_likelihood,
    spin_behind_bounce,
)
from common.rally.launch_presets import PRESETS

UP = (0.0, 0.0, 1.0)
COMING = (-5.0, 0.8, -2.5)
SATURATED = 64.0  # rad/s
MILD, MIXED, STRONG = 1.0, 0.5, 0.0
SHOWN_SIGMA = 18.0  # rad/s
ERROR = 0.09  # m/s
NOWHERE = (1e6, 1e6, 1e6)
MANY = quasi_random(20_000)
BALLS = 300_000


def in_sphere(count, radius, rng) -> np.ndarray:
    ways = rng.standard_normal((count, 3))
    return radius * rng.random((count, 1)) ** (1 / 3) * ways / np.linalg.norm(ways, axis=1, keepdims=True)


def shows(spins: np.ndarray) -> np.ndarray:
    rate = np.linalg.norm(spins, axis=-1, keepdims=True)
    return spins * np.minimum(rate, SATURATED) / rate


TOLD = (
    np.array([[1.0, 0.0, 0.0], [0.6, 1.2, 0.0], [-0.4, 0.3, 0.8]]) / SHOWN_SIGMA
)  # square root of what is told
ERRORS = np.array([[1.0, 0.0], [0.5, 0.7]])  # of the change along the table, as multiples


def told(spin) -> tuple:
    """Return what a ball of this spin shows: change of velocity, pull and agree."""
    rising, _ = table_bounce(COMING, spin, UP, 0.975, 0.25)
    agree = TOLD @ TOLD.T
    return tuple(np.subtract(rising, COMING)), tuple(agree @ shows(np.array(spin))), agree


def concluded(spin, mild, points, error=ERROR) -> tuple[np.ndarray, float]:
    change, pull, agree = told(spin)
    spin, is_mild = spin_behind_bounce(
        COMING,
        change,
        tuple(error * ERRORS[[0, 1, 1], [0, 0, 1]]),
        pull,
        agree,
        SATURATED,
        mild,
        NOWHERE,
        points,
    )
    return np.array(spin), is_mild


def found(spin, mild, points, error=ERROR) -> np.ndarray:
    return concluded(spin, mild, points, error)[0]


@cache
def drawn(spin, mild) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean and sigma of the spin behind the bounce among all balls that agree with what was told.

    And the share of mild ones among them.
    """
    rng = np.random.default_rng(0)
    is_mild = rng.random((BALLS, 1)) < mild
    spins, frictions = (
        in_sphere(BALLS, np.where(is_mild, INNER, OUTER), rng),
        rng.normal(0.25, 0.029, BALLS),
    )
    change, pull, agree = told(spin)
    behind = np.array(
        [
            np.concatenate(table_bounce(COMING, tuple(w), UP, 0.975, mu))
            for w, mu in zip(spins, frictions, strict=True)
        ]
    )
    off = np.linalg.solve(ERROR * ERRORS, (behind[:, :2] - COMING[:2] - change[:2]).T).T
    s = shows(spins)
    logs = s @ pull - 0.5 * np.einsum("ni,ij,nj->n", s, agree, s) - 0.5 * (off**2).sum(axis=1)
    weights = np.exp(logs - logs.max())
    mean = np.average(behind[:, 3:], axis=0, weights=weights)
    assert weights.sum() ** 2 / (weights**2).sum() > 150.0  # enough of them agree
    sigma = np.sqrt(np.average((behind[:, 3:] - mean) ** 2, axis=0, weights=weights))
    return mean, sigma, np.average(is_mild[:, 0], weights=weights)


CASES = [
    ((20.0, -50.0, 30.0), MILD),  # slides
    ((10.0, -200.0, 60.0), STRONG),  # topspin: rolls
    ((10.0, 120.0, -150.0), STRONG),  # backspin: slides
    ((-120.0, -40.0, 180.0), STRONG),
    ((20.0, -50.0, 60.0), MIXED),
    ((30.0, -160.0, 120.0), MIXED),
]


@pytest.mark.parametrize(("points", "sigmas", "share_off"), [(MANY, 0.2, 0.06), (POINTS, 0.6, 0.25)])
@pytest.mark.parametrize(("spin", "mild"), CASES)
def test_it_is_the_mean_of_all_balls_that_agree(spin, mild, points, sigmas, share_off):
    """Of many points nearly, and the few that are used do."""
    mean, sigma, share = drawn(spin, mild)
    said, is_mild = concluded(spin, mild, points)

    assert (np.abs(said - mean) < sigmas * sigma + 1.0).all()
    assert is_mild == pytest.approx(share, abs=share_off)


def test_a_ball_of_either_kind_is_known_for_it():
    """A strong one at once; a mild one only less and less likely a strong one."""
    assert concluded((10.0, -220.0, 60.0), MIXED, MANY)[1] < 0.02
    assert concluded((20.0, -40.0, 20.0), MIXED, MANY)[1] > 0.9


def test_a_rolling_bounce_tells_the_spin_in_the_tables_plane():
    """However strong it is, and without the flight's help."""
    spin = (-90.0, -210.0, 40.0)
    _, behind = table_bounce(COMING, spin, UP, 0.975, 0.25)

    np.testing.assert_allclose(found(spin, STRONG, MANY, error=0.005)[:2], behind[:2], atol=4.0)


def test_a_sliding_bounce_tells_the_spins_direction():
    """Mirror images of a spin that the flight can't tell apart, left and right of it, it does."""
    left, right = (found((side * 150.0, 100.0, 0.0), STRONG, MANY) for side in (-1, 1))

    assert left[0] < -60.0
    assert right[0] > 60.0


def test_the_sign_of_the_sidespin_is_the_flights():
    """Where nothing is told of it, there is as much of one as of the other: none, on average."""
    told_so = found((0.0, 100.0, 150.0), STRONG, MANY)
    change, pull, agree = told((0.0, 100.0, 150.0))
    agree[2] = [0.0, 0.0, 1e-8]
    hidden, _ = spin_behind_bounce(
        COMING,
        change,
        (ERROR, 0.0, ERROR),
        (pull[0], pull[1], 0.0),
        agree,
        SATURATED,
        STRONG,
        NOWHERE,
        MANY,
    )

    assert told_so[2] > 80.0
    assert abs(hidden[2]) < 15.0


def test_there_are_as_many_balls_of_either_kind():
    rate = np.linspace(0.5, 399.5, 400)
    dense = np.array([densities(r) for r in rate])

    shells = 4 * np.pi * rate[:, None] ** 2
    np.testing.assert_allclose((shells * dense).sum(axis=0), 4 / 3 * np.pi * OUTER**3, rtol=0.02)


def test_what_a_flight_says_is_the_estimate_less_its_prior_with_the_lift_factors_spread():
    rows = np.random.default_rng(0).standard_normal((3, 6))
    alone, shown = 60.0 * rows @ rows.T, np.array([20.0, -50.0, 30.0])
    prior = np.eye(3) / 50.0**2
    covariance = np.linalg.inv(np.linalg.inv(alone) + prior)
    by_itself = alone @ np.linalg.solve(covariance, shown)  # whose mean with the prior is the estimate
    pull, agree = np.empty(3), np.empty((3, 3))
    shown_likelihood(tuple(shown), covariance, 50.0, pull, agree)
    wider = alone + 0.115**2 * np.outer(shown, shown)

    np.testing.assert_allclose(agree, np.linalg.inv(wider), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(pull, np.linalg.solve(wider, by_itself), rtol=1e-9)


def test_where_nothing_agrees_it_says_what_it_was_given():
    """A ball without velocity: no lift could have shown anything."""
    change, pull, agree = told((20.0, -50.0, 30.0))
    spin = spin_behind_bounce(
        (0.0, 0.0, 0.0), change, (ERROR, 0.0, ERROR), pull, agree, 0.0, MILD, (1.0, 2.0, 3.0), POINTS
    )

    assert spin == ((1.0, 2.0, 3.0), MILD)


def test_few_points_err_by_a_third_of_what_is_left_uncertain():
    """Root mean square over many balls. Measured: .3."""
    rng, errors = np.random.default_rng(1), []
    for spin in np.concatenate([in_sphere(20, INNER, rng), in_sphere(20, OUTER, rng)]):
        mild = float(np.linalg.norm(spin) < INNER)
        behind = np.array(table_bounce(COMING, tuple(spin), UP, 0.975, 0.25)[1])
        many = found(tuple(spin), mild, MANY)
        errors.append((found(tuple(spin), mild, POINTS) - many, many - behind))
    few, left = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))

    assert few < 0.45 * left


def test_a_spin_beyond_all_that_is_expected_is_found_where_the_ball_rolls():
    spin = (-20.0, -340.0, 30.0)
    _, behind = table_bounce(COMING, spin, UP, 0.975, 0.25)
    said = found(spin, STRONG, MANY, error=0.02)

    np.testing.assert_allclose(said[:2], behind[:2], atol=30.0)
    assert abs(said[2]) < 350.0


def test_spheres_are_those_of_the_launch_presets():
    assert PRESETS["paper"].spin_radii == (INNER, INNER)
    assert PRESETS["strong"].spin_radii == (OUTER, OUTER)
    assert PRESETS["mixed"].spin_radii == (INNER, OUTER)


def test_points_are_spread_evenly():
    for column, (low, high) in enumerate([(-0.15, 0.15), (-0.15, 0.15), (0.45, 0.55), (-0.15, 0.15)]):
        assert low < POINTS[:, column].mean() < high
    assert POINTS[:, [0, 1, 3]].std(axis=0) == pytest.approx(np.ones(3), abs=0.15)
    assert len(np.unique(POINTS.round(6), axis=0)) == len(POINTS)
