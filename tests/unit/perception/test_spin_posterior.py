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
    stroke_density,
    stroke_prior,
)
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
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


def strokes(count, rng) -> np.ndarray:
    """Return spins of players' strokes for a ball of velocity BEFORE."""
    speed = np.sqrt(31.89)
    back, top = (
        0.33 / 0.6 * np.exp(-0.5 * ((speed - 4.8) / 0.6) ** 2),
        0.67 / 2.9 * np.exp(-0.5 * ((speed - 9.3) / 2.9) ** 2),
    )
    is_back = rng.random(count) < back / (back + top)
    middle = np.where(is_back, -507.0 + 69.5 * speed, 40.0 + 40.0 * speed)
    topspin = middle + np.where(is_back, 90.0, 180.0) * rng.standard_normal(count)
    gyro, side = 65.0 * rng.standard_normal(count), 37.0 + 110.0 * rng.standard_normal(count)
    ex, ey = np.array([-5.0, 0.8]) / np.sqrt(25.64)
    return np.stack([gyro * ex - topspin * ey, gyro * ey + topspin * ex, side], axis=1)


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
    spins = in_sphere(BALLS, np.where(is_mild, 100.0, 300.0), rng)
    is_stroke = ~is_mild & (rng.random((BALLS, 1)) < 0.5)
    spins = np.where(is_stroke, strokes(BALLS, rng), spins)
    frictions = rng.normal(0.25, 0.029, BALLS)
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
    ((20.0, -330.0, 60.0), STRONG),  # a player's topspin, which rolls
    ((-10.0, 220.0, 40.0), STRONG),  # a player's backspin
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
    """Without evidence of the flight the mean is the prior's: 0 in the sphere, 37 rad/s of players."""
    with_evidence = posterior_mean((0.0, 100.0, 150.0), STRONG, MANY)
    change, vector, matrix = evidence_of((0.0, 100.0, 150.0))
    matrix[2] = [0.0, 0.0, 1e-8]
    evidence = FlightEvidence((vector[0], vector[1], 0.0), matrix, SATURATED)
    hidden, _ = spin_after_bounce(
        MeasuredBounce(BEFORE, change, (ERROR, 0.0, ERROR)), evidence, STRONG, FALLBACK, MANY
    )

    assert with_evidence[2] > 80.0
    assert -10.0 < hidden[2] < 47.0


def test_both_kinds_have_the_same_total_density():
    rate = np.linspace(0.5, 399.5, 400)
    density = np.array([densities(r) for r in rate])

    shells = 4 * np.pi * rate[:, None] ** 2
    np.testing.assert_allclose((shells * density).sum(axis=0), 4 / 3 * np.pi * STRONG_RADIUS**3, rtol=0.02)


def test_the_density_of_strokes_is_that_of_the_balls_drawn_from_it():
    """In a box around 200 spins of them: as many as the density says."""
    rng = np.random.default_rng(3)
    drawn, prior, unit = strokes(BALLS, rng), stroke_prior(BEFORE), 4 / 3 * np.pi * 300.0**3
    half = 40.0
    for centre in drawn[:200]:
        inside = (np.abs(drawn - centre) < half).all(axis=1).sum()
        around = centre + rng.uniform(-half, half, (200, 3))
        expected = np.mean([stroke_density(prior, *w) for w in around]) / unit * (2 * half) ** 3 * BALLS
        assert abs(inside - expected) < 5.0 * np.sqrt(expected) + 0.05 * expected + 5.0


def test_strokes_are_those_of_the_preset_match_at_their_bounce():
    rallies = draw_rallies(1500, TaskConfig.model_validate({"launch": "match"}), seed=4)
    topspins, speeds, others = [], [], []
    for launch in rallies.launches:
        _, v, *_ = fly_to_touch(
            *map(tuple, launch[:9].reshape(3, 3)), 1.0, Air(*launch[9:11], FULL), NO_ROBOT
        )
        ex, ey = v[0] / np.hypot(v[0], v[1]), v[1] / np.hypot(v[0], v[1])
        wx, wy, wz = launch[6:9]
        topspins.append(wy * ex - wx * ey)
        speeds.append(np.linalg.norm(v))
        others.append((wz, wx * ex + wy * ey))
    topspins, speeds, others = map(np.array, (topspins, speeds, others))
    back, fast = topspins < 0.0, speeds > 7.5  # so fast a ball has no backspin

    assert back.mean() == pytest.approx(0.33, abs=0.06)
    assert (back & fast).mean() < 0.01
    off = topspins[fast] - (40.0 + 40.0 * speeds[fast])
    assert abs(off.mean()) < 35.0
    assert off.std() == pytest.approx(180.0, abs=40.0)
    assert speeds[back].mean() == pytest.approx(4.8, abs=0.3)
    assert abs((topspins[back] - (-507.0 + 69.5 * speeds[back])).mean()) < 35.0
    np.testing.assert_allclose(others.mean(axis=0), [37.0, 0.0], atol=20.0)
    np.testing.assert_allclose(others.std(axis=0), [110.0, 65.0], atol=15.0)


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
