"""The spin posterior agrees with importance sampling over hundreds of thousands of random balls."""

from functools import cache

import numpy as np
import pytest

from common.perception.spin_posterior import (
    MILD_RADIUS,
    POINTS,
    STRONG_RADIUS,
    FlightEvidence,
    MeasuredBounce,
    densities,
    flight_information,
    quasi_random,
    spin_after_bounce,
)
from common.physics.table_bounce import table_bounce
from common.task.launch_presets import KINDS, Kind

UP = (0.0, 0.0, 1.0)
BEFORE = (-5.0, 0.8, -2.5)  # m/s
SATURATED = 64.0  # rad/s
MILD, MIXED, STRONG = 1.0, 0.5, 0.0
FLIGHT_SIGMA = 18.0  # [rad/s] of the flight's evidence
ERROR = 0.09  # m/s
FALLBACK = (1e6, 1e6, 1e6)
MANY = quasi_random(20_000)
BALLS = 300_000


def in_sphere(count, radius, rng) -> np.ndarray:
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * rng.random((count, 1)) ** (1 / 3) * directions


def visible(spins: np.ndarray) -> np.ndarray:
    rate = np.linalg.norm(spins, axis=-1, keepdims=True)
    return spins * np.minimum(rate, SATURATED) / rate


# Square root of the flight's information matrix
EVIDENCE_ROOT = np.array([[1.0, 0.0, 0.0], [0.6, 1.2, 0.0], [-0.4, 0.3, 0.8]]) / FLIGHT_SIGMA
ERRORS = np.array([[1.0, 0.0], [0.5, 0.7]])  # of the change along the table, as multiples


def evidence_of(spin) -> tuple:
    """Return the evidence of a ball with this spin: change of velocity, information vector and matrix."""
    rising, _ = table_bounce(BEFORE, spin, UP, 0.975, 0.25)
    matrix = EVIDENCE_ROOT @ EVIDENCE_ROOT.T
    return tuple(np.subtract(rising, BEFORE)), tuple(matrix @ visible(np.array(spin))), matrix


def posterior(spin, mild, points, error=ERROR) -> tuple[np.ndarray, float]:
    change, vector, matrix = evidence_of(spin)
    bounce = MeasuredBounce(BEFORE, change, tuple(error * ERRORS[[0, 1, 1], [0, 0, 1]]))
    evidence = FlightEvidence(vector, matrix, SATURATED)
    mean, mild_probability = spin_after_bounce(bounce, evidence, mild, FALLBACK, points)
    return np.array(mean), mild_probability


def posterior_mean(spin, mild, points, error=ERROR) -> np.ndarray:
    return posterior(spin, mild, points, error)[0]


@cache
def reference(spin, mild) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean and sigma of the spin after the bounce, and the share of mild balls.

    All three are over random balls of the prior, weighted by their agreement with the evidence.
    """
    rng = np.random.default_rng(0)
    is_mild = rng.random((BALLS, 1)) < mild
    spins, frictions = (
        in_sphere(BALLS, np.where(is_mild, MILD_RADIUS, STRONG_RADIUS), rng),
        rng.normal(0.25, 0.029, BALLS),
    )
    change, vector, matrix = evidence_of(spin)
    after = np.array(
        [
            np.concatenate(table_bounce(BEFORE, tuple(w), UP, 0.975, mu))
            for w, mu in zip(spins, frictions, strict=True)
        ]
    )
    off = np.linalg.solve(ERROR * ERRORS, (after[:, :2] - BEFORE[:2] - change[:2]).T).T
    s = visible(spins)
    logs = s @ vector - 0.5 * np.einsum("ni,ij,nj->n", s, matrix, s) - 0.5 * (off**2).sum(axis=1)
    weights = np.exp(logs - logs.max())
    mean = np.average(after[:, 3:], axis=0, weights=weights)
    assert weights.sum() ** 2 / (weights**2).sum() > 150.0  # effective number of balls
    sigma = np.sqrt(np.average((after[:, 3:] - mean) ** 2, axis=0, weights=weights))
    return mean, sigma, np.average(is_mild[:, 0], weights=weights)


CASES = [
    ((20.0, -50.0, 30.0), MILD),  # slides
    ((10.0, -200.0, 60.0), STRONG),  # topspin: rolls
    ((10.0, 120.0, -150.0), STRONG),  # backspin: slides
    ((-120.0, -40.0, 180.0), STRONG),
    ((20.0, -50.0, 60.0), MIXED),
    ((30.0, -160.0, 120.0), MIXED),
]


@pytest.mark.parametrize(("points", "sigmas", "share_error"), [(MANY, 0.2, 0.06), (POINTS, 0.6, 0.25)])
@pytest.mark.parametrize(("spin", "mild"), CASES)
def test_the_posterior_is_the_weighted_mean_of_random_balls(spin, mild, points, sigmas, share_error):
    """With many points almost exactly, and with the points in use approximately."""
    mean, sigma, share = reference(spin, mild)
    found, mild_probability = posterior(spin, mild, points)

    assert (np.abs(found - mean) < sigmas * sigma + 1.0).all()
    assert mild_probability == pytest.approx(share, abs=share_error)


def test_mild_and_strong_balls_are_recognised():
    """A strong ball at once. A mild ball slowly: a strong one may look the same."""
    assert posterior((10.0, -220.0, 60.0), MIXED, MANY)[1] < 0.02
    assert posterior((20.0, -40.0, 20.0), MIXED, MANY)[1] > 0.9


def test_a_rolling_bounce_gives_the_spin_in_the_tables_plane():
    """Also of a strong spin, whose rate the flight does not show."""
    spin = (-90.0, -210.0, 40.0)
    _, after = table_bounce(BEFORE, spin, UP, 0.975, 0.25)

    np.testing.assert_allclose(posterior_mean(spin, STRONG, MANY, error=0.005)[:2], after[:2], atol=4.0)


def test_a_sliding_bounce_gives_the_spins_direction():
    """It separates two mirror images of a spin that look the same in the flight."""
    left, right = (posterior_mean((side * 150.0, 100.0, 0.0), STRONG, MANY) for side in (-1, 1))

    assert left[0] < -60.0
    assert right[0] > 60.0


def test_the_sign_of_the_sidespin_comes_from_the_flight():
    """Without evidence of the flight both signs are equally probable, and the mean is 0."""
    with_evidence = posterior_mean((0.0, 100.0, 150.0), STRONG, MANY)
    change, vector, matrix = evidence_of((0.0, 100.0, 150.0))
    matrix[2] = [0.0, 0.0, 1e-8]
    evidence = FlightEvidence((vector[0], vector[1], 0.0), matrix, SATURATED)
    hidden, _ = spin_after_bounce(
        MeasuredBounce(BEFORE, change, (ERROR, 0.0, ERROR)), evidence, STRONG, FALLBACK, MANY
    )

    assert with_evidence[2] > 80.0
    assert abs(hidden[2]) < 15.0


def test_both_kinds_have_the_same_total_density():
    rate = np.linspace(0.5, 399.5, 400)
    density = np.array([densities(r) for r in rate])

    shells = 4 * np.pi * rate[:, None] ** 2
    np.testing.assert_allclose((shells * density).sum(axis=0), 4 / 3 * np.pi * STRONG_RADIUS**3, rtol=0.02)


def test_the_flights_information_is_the_estimate_without_its_prior_widened_by_the_lift_factor():
    rows = np.random.default_rng(0).standard_normal((3, 6))
    alone, estimate = 60.0 * rows @ rows.T, np.array([20.0, -50.0, 30.0])
    prior = np.eye(3) / 50.0**2
    covariance = np.linalg.inv(np.linalg.inv(alone) + prior)
    without_prior = alone @ np.linalg.solve(covariance, estimate)  # its mean with the prior is the estimate
    vector, matrix = np.empty(3), np.empty((3, 3))
    flight_information(tuple(estimate), covariance, 50.0, vector, matrix)
    wider = alone + 0.115**2 * np.outer(estimate, estimate)

    np.testing.assert_allclose(matrix, np.linalg.inv(wider), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(vector, np.linalg.solve(wider, without_prior), rtol=1e-9)


def test_without_any_agreement_the_fallback_and_the_prior_are_returned():
    """A ball without velocity has no lift, so no spin is visible."""
    change, vector, matrix = evidence_of((20.0, -50.0, 30.0))
    bounce = MeasuredBounce((0.0, 0.0, 0.0), change, (ERROR, 0.0, ERROR))
    spin = spin_after_bounce(bounce, FlightEvidence(vector, matrix, 0.0), MILD, (1.0, 2.0, 3.0), POINTS)

    assert spin == ((1.0, 2.0, 3.0), MILD)


def test_the_error_of_few_points_is_a_third_of_the_posteriors_spread():
    """Root mean square over many balls. Measured: 0.3."""
    rng, errors = np.random.default_rng(1), []
    for spin in np.concatenate([in_sphere(20, MILD_RADIUS, rng), in_sphere(20, STRONG_RADIUS, rng)]):
        mild = float(np.linalg.norm(spin) < MILD_RADIUS)
        after = np.array(table_bounce(BEFORE, tuple(spin), UP, 0.975, 0.25)[1])
        many = posterior_mean(tuple(spin), mild, MANY)
        errors.append((posterior_mean(tuple(spin), mild, POINTS) - many, many - after))
    few, left = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))

    assert few < 0.45 * left


def test_a_spin_outside_the_prior_is_found_if_the_ball_rolls():
    spin = (-20.0, -340.0, 30.0)
    _, after = table_bounce(BEFORE, spin, UP, 0.975, 0.25)
    found = posterior_mean(spin, STRONG, MANY, error=0.02)

    np.testing.assert_allclose(found[:2], after[:2], atol=30.0)
    assert abs(found[2]) < 350.0


def test_spheres_are_those_of_the_kinds_of_ball():
    assert KINDS[Kind.PAPER].spin_radius == MILD_RADIUS
    assert KINDS[Kind.STRONG].spin_radius == STRONG_RADIUS


def test_points_are_spread_evenly():
    for column, (low, high) in enumerate([(-0.15, 0.15), (-0.15, 0.15), (0.45, 0.55), (-0.15, 0.15)]):
        assert low < POINTS[:, column].mean() < high
    assert POINTS[:, [0, 1, 3]].std(axis=0) == pytest.approx(np.ones(3), abs=0.15)
    assert len(np.unique(POINTS.round(6), axis=0)) == len(POINTS)
