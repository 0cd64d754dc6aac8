"""Flight: parabola, drag, a lift that saturates, the full model's tables, symmetry, accuracy of the step."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.physics.flight import (
    FULL,
    SIMPLE,
    Air,
    acceleration,
    flight_step,
    full_drag,
    full_magnus,
)
from common.physics.vec import Vec
from tests.unit.physics.contacts import mirrored, mirrored_spin, vectors

ORIGIN = (0.0, 0.0, 0.0)
GRAVITY, GRID_STEP, BALL_RADIUS = 9.81, 0.005, 0.020  # m/s^2, s, m
# rho A/2m [1/m] and rho V/m [-] with 1.204 kg/m^3 and 2.7 g
AIR_FACTOR = 1.204 * math.pi * 0.020**2 / (2 * 0.0027)
AIR_VOLUME_FACTOR = 1.204 * 4 / 3 * math.pi * 0.020**3 / 0.0027
both_models = pytest.mark.parametrize("model", [SIMPLE, FULL], ids=["simple", "full"])
factors = st.floats(0.5, 1.5)


def accelerate(
    vel: Vec, spin: Vec = ORIGIN, drag: float = 1.0, lift: float = 1.0, model: int = SIMPLE
) -> Vec:
    return acceleration(vel, spin, Air(drag, lift, model))


def fly(vel: Vec, spin: Vec, steps: int, h: float, model: int = SIMPLE, drag: float = 1.0, lift: float = 1.0):
    pos = ORIGIN
    for _ in range(steps):
        pos, vel = flight_step(pos, vel, spin, h, Air(drag, lift, model))
    return pos, vel


@both_models
def test_flight_without_air_is_a_parabola(model):
    pos, vel = fly((-5.0, 1.0, 2.0), (10.0, -300.0, 50.0), 100, GRID_STEP, model, drag=0.0, lift=0.0)
    t = 100 * GRID_STEP

    np.testing.assert_allclose(pos, [-5.0 * t, 1.0 * t, 2.0 * t - 0.5 * GRAVITY * t**2], atol=1e-13)
    np.testing.assert_allclose(vel, [-5.0, 1.0, 2.0 - GRAVITY * t], atol=1e-13)


@both_models
@pytest.mark.parametrize("spin", [ORIGIN, (0.0, 500.0, 0.0)])
def test_a_ball_at_rest_only_falls(spin, model):
    assert accelerate(ORIGIN, spin, model=model) == (0.0, 0.0, -GRAVITY)


def test_simple_drag_is_quadratic_and_against_the_flight():
    a = np.add(accelerate((-6.0, 0.0, 8.0)), [0.0, 0.0, GRAVITY])

    np.testing.assert_allclose(a, -0.280 * 0.55 * 10.0 * np.array([-6.0, 0.0, 8.0]), rtol=1e-3)


def test_simple_lift_grows_with_spin_and_then_saturates():
    """C_L = min(1.067 S, 0.267): at 8 m/s the lift stops growing at 100 rad/s."""
    lift = [accelerate((-8.0, 0.0, 0.0), (0.0, w, 0.0))[2] + GRAVITY for w in (50.0, 100.0, 200.0, 800.0)]

    np.testing.assert_allclose(
        lift, AIR_FACTOR * 64.0 * np.array([1.067 * 0.125, 1.067 * 0.25, 0.267, 0.267]), rtol=1e-3
    )


@both_models
def test_topspin_dives_backspin_floats_and_sidespin_curves(model):
    topspin, backspin = (accelerate((-8.0, 0.0, 0.0), (0.0, w, 0.0), model=model)[2] for w in (-200.0, 200.0))
    left = accelerate((-8.0, 0.0, 0.0), (0.0, 0.0, -200.0), model=model)[1]

    assert topspin < -GRAVITY < backspin
    assert left > 1.0


@both_models
@given(vectors(15.0), vectors(500.0), factors, factors)
def test_flight_is_mirror_symmetric_bit_for_bit(model, vel, spin, drag, lift):
    pos, end = flight_step(ORIGIN, vel, spin, GRID_STEP, Air(drag, lift, model))
    image = flight_step(ORIGIN, mirrored(vel), mirrored_spin(spin), GRID_STEP, Air(drag, lift, model))

    assert image == (mirrored(pos), mirrored(end))


@both_models
@given(vectors(15.0), vectors(500.0), st.floats(-math.pi, math.pi))
def test_flight_is_the_same_in_every_horizontal_direction(model, vel, spin, angle):
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = accelerate(tuple(R @ vel), tuple(R @ spin), model=model)

    np.testing.assert_allclose(turned, R @ accelerate(vel, spin, model=model), rtol=1e-9, atol=1e-9)


@both_models
@given(vectors(15.0), vectors(500.0), factors, factors)
def test_the_air_never_adds_energy(model, vel, spin, drag, lift):
    a = np.add(accelerate(vel, spin, drag, lift, model), [0.0, 0.0, GRAVITY])

    assert a @ vel <= 1e-9


@both_models
def test_each_factor_scales_drag_or_lift_alone(model):
    vel, spin = (-8.0, 1.0, 0.5), (30.0, -250.0, 60.0)
    still, drag, lift, both = (
        np.array(accelerate(vel, spin, d, m, model)) for d, m in ((0, 0), (1, 0), (0, 1), (1.1, 0.8))
    )

    np.testing.assert_allclose(both - still, 1.1 * (drag - still) + 0.8 * (lift - still), atol=1e-12)


@both_models
@pytest.mark.parametrize("spin", [ORIGIN, (0.0, -150.0, 0.0), (100.0, 400.0, -200.0)])
def test_half_a_second_on_the_grid_is_exact_to_ten_micrometres(spin, model):
    coarse, _ = fly((-9.0, 1.5, 2.0), spin, 100, GRID_STEP, model)
    fine, _ = fly((-9.0, 1.5, 2.0), spin, 100 * 64, GRID_STEP / 64, model)

    np.testing.assert_allclose(coarse, fine, atol=1e-5)


@pytest.mark.parametrize(
    ("speed", "spin_parameter", "expected"),
    [
        (0.0, 0.0, 0.55),
        (2.5, 1.7, 0.55),
        (7.5, 0.0, 0.49),
        (7.5, 0.4, 0.49),
        (7.5, 0.75, 0.55),
        (7.5, 1.10, 0.48),
        (7.5, 2.0, 0.53),
        (7.5, 9.0, 0.53),
        (7.5, 0.575, 0.52),  # halfway between knots
        (12.5, 0.62, 0.53),
        (12.5, 0.95, 0.41),
        (17.5, 0.50, 0.51),
        (17.5, 0.84, 0.37),
        (17.5, 2.0, 0.45),
        (10.0, (0.75 + 0.62) / 2, 0.54),  # halfway between speeds, at the interpolated knot
        (10.0, 0.0, 0.48),
        (22.5, 0.84, 0.33),  # along the slope of the last two rows
        (60.0, 0.84, 0.30),  # the lower limit
    ],
)
def test_full_drag_reproduces_the_published_knots(speed, spin_parameter, expected):
    assert full_drag(speed, spin_parameter) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("speed", "spin_rate", "expected"),
    [
        (1.0, 100.0, 0.080),
        (2.0, 150.0, 0.080),
        (3.5, 0.0, 0.310),
        (3.5, 200.0, 0.090),
        (7.5, 200.0, 0.211),
        (7.5, 400.0, 0.09475),
        (10.5, 440.0, 0.08548),
        (13.5, 500.0, 0.103),
        (13.5, 600.0, 0.103574),
        (17.0, 600.0, 0.1022),
        (25.0, 600.0, 0.1022),
        (9.0, 100.0, (0.366 - 0.0775 + 0.375 - 0.0658) / 2),  # halfway between speeds
        (2.0, 5000.0, 0.0),
    ],
)
def test_full_magnus_reproduces_the_published_parameters(speed, spin_rate, expected):
    assert full_magnus(speed, spin_rate) == pytest.approx(expected, abs=1e-9)


def test_the_full_model_is_continuous_in_speed():
    for speed in (2.5, 3.5, 7.5, 10.5, 12.5, 13.5, 17.0, 17.5):
        for spin_rate in (20.0, 120.0, 300.0):
            below, above = (accelerate((-v, 0.0, 0.0), (0.0, spin_rate, 0.0), model=FULL) for v in
                            (speed * (1 - 1e-9), speed * (1 + 1e-9)))  # fmt: skip

            np.testing.assert_allclose(below, above, atol=1e-6)


def test_the_full_models_drag_at_a_vanishing_spin_is_that_of_a_ball_without_spin():
    spinless = accelerate((-7.5, 0.0, 0.0), model=FULL)
    almost = accelerate((-7.5, 0.0, 0.0), (0.0, 1e-9, 0.0), model=FULL)

    assert spinless[0] == pytest.approx(AIR_FACTOR * 0.49 * 7.5**2)
    np.testing.assert_allclose(almost, spinless, atol=1e-8)


def test_full_lift_per_volume_equals_lift_per_area():
    """C_L = (8/3) C_M S for a spin across the flight."""
    speed, spin_rate = 9.0, 200.0
    lift = accelerate((-speed, 0.0, 0.0), (0.0, spin_rate, 0.0), model=FULL)[2] + GRAVITY
    C_L = 8.0 / 3.0 * full_magnus(speed, spin_rate) * BALL_RADIUS * spin_rate / speed

    assert lift == pytest.approx(AIR_FACTOR * C_L * speed**2)
    assert pytest.approx(8.0 / 3.0 * BALL_RADIUS) == AIR_VOLUME_FACTOR / AIR_FACTOR
