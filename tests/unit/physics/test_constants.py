"""The constants against the rules of the game and the sources, as numbers that are written out here."""

import math

import pytest

from common.physics import constants


@pytest.mark.parametrize(
    ("name", "value"),
    [
        # ITTF Laws 2.01 and 2.02: table 2.74 m x 1.525 m, 0.76 m high; net 0.1525 m high, 0.1525 m beyond each side
        ("TABLE_HALF_LENGTH", 2.74 / 2),
        ("TABLE_HALF_WIDTH", 1.525 / 2),
        ("FLOOR_Z", -0.76),
        ("NET_HEIGHT", 0.1525),
        ("NET_HALF_WIDTH", 1.525 / 2 + 0.1525),
        ("TABLE_THICKNESS", 0.025),
        # ITTF Law 2.03: ball 40 mm, 2.7 g; a thin shell has the inertia 2/3 m r^2
        ("BALL_RADIUS", 0.040 / 2),
        ("BALL_MASS", 0.0027),
        ("BALL_INERTIA", 7.2e-7),
        ("BALL_AREA", math.pi * 4e-4),
        ("BALL_VOLUME", 4 / 3 * math.pi * 8e-6),
        ("ROLLING_ALPHA", 0.4),
        ("SPIN_PER_VELOCITY", 75.0),
        # air at 20 degrees C
        ("GRAVITY", 9.81),
        ("AIR_DENSITY", 1.204),
        ("AIR_FACTOR", 1.204 * math.pi * 4e-4 / 0.0054),
        ("AIR_VOLUME_FACTOR", 1.204 * 4 / 3 * math.pi * 8e-6 / 0.0027),
        # Conti et al. 2026
        ("TABLE_RESTITUTION0", 0.98),
        ("TABLE_RESTITUTION_SLOPE", 0.02),
        ("TABLE_FRICTION", 0.25),
        ("MIN_RESTITUTION", 0.2),
        ("GRID_STEP", 0.005),
    ],
)
def test_a_constant_has_the_value_of_its_source(name, value):
    assert getattr(constants, name) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        # Conti et al. 2026 and Nakashima 2010: e_0, slope [s/m], alpha, spin loss, friction
        ("inverted", (0.878, 0.020, 0.70, 0.2, math.inf)),
        # Gossard 2026, rackets 8, 7, 5, 6 and 10; the spin loss is that of inverted rubber
        ("short_pips", (0.866, 0.0163, 0.69, 0.2, math.inf)),
        ("medium_pips", (0.772, 0.0138, 0.52, 0.2, math.inf)),
        ("long_pips", (0.749, 0.0073, 0.30, 0.2, math.inf)),
        ("long_pips_ox", (0.729, 0.0055, 0.25, 0.2, math.inf)),
        ("anti_spin", (0.533, 0.0, 0.4, 0.2, 0.189)),
    ],
)
def test_a_rubber_has_the_published_values(name, values):
    assert tuple(constants.RUBBERS[name]) == values
