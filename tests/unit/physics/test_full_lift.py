"""The lift of the full model has no jump where its line meets its parabola."""

import numpy as np
import pytest

from common.physics.flight import FULL, Air, full_magnus
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.touch import ROBOT_COURT
from common.physics.vec import Vec

STEP = 0.1  # rad/s


TOPSPIN = ((1.0, 0.0, 0.35), (-4.8, 0.0, 1.2), -1.0)
BACKSPIN = ((1.2, 0.0, 0.494), (-4.32, 0.0, 2.35), 1.0)


def landing_x(pos: Vec, vel: Vec, turns: float, spin_rate: float) -> float:
    """Return where a ball lands on the robot's court [m]."""
    place, _, _, what, _ = fly_to_touch(
        pos, vel, (0.0, turns * spin_rate, 0.0), 2.0, Air(1.0, 1.0, FULL), NO_ROBOT
    )
    assert what == ROBOT_COURT
    return place[0]


def largest_jump(values: np.ndarray) -> float:
    """Return the largest difference of neighbours, divided by the largest of the others within 10 steps."""
    steps = np.abs(np.diff(values))
    at = int(steps.argmax())
    near = [steps[k] for k in range(max(at - 10, 0), min(at + 11, len(steps))) if k != at]
    return float(steps[at] / max(near))


@pytest.mark.parametrize("ball", [TOPSPIN, BACKSPIN], ids=["topspin", "backspin"])
def test_a_landing_changes_smoothly_with_the_spin(ball):
    """Spins of 200 to 300 rad/s: the line's end is at 200 to 250 rad/s for the speeds of these balls."""
    landings = np.array([landing_x(*ball, w) for w in np.arange(200.0, 300.0, STEP)])

    assert largest_jump(landings) < 1.1
    # 0.94 mm per rad/s on the line before its end; as published the landings jump by 0.12 and 0.41 mm
    assert np.abs(np.diff(landings)).max() < 1e-3 * STEP


@pytest.mark.parametrize(
    "speed", [1.0, 2.0, 3.0, 3.5, 4.8, 6.0, 7.5, 9.0, 10.5, 12.0, 13.5, 15.0, 17.0, 25.0]
)
def test_the_lift_coefficient_is_continuous_in_the_spin(speed):
    """No slope is steeper than 1.2e-3 s: the steepest published one is 1.1e-3 s, at 3.5 m/s."""
    coefficients = np.array([full_magnus(speed, w) for w in np.arange(0.0, 1000.0, STEP)])

    assert np.abs(np.diff(coefficients)).max() < 1.2e-3 * STEP


@pytest.mark.parametrize(
    ("speed", "spin_rate", "line"),
    [
        (2.0, 150.0, 0.080),
        (3.5, 200.0, 0.090),
        (10.5, 440.0, 0.08548),
        (13.5, 550.0, 0.075),
        (17.0, 650.0, 0.0798),
    ],
)
def test_up_to_its_end_the_published_line_holds(speed, spin_rate, line):
    assert full_magnus(speed, spin_rate) == pytest.approx(line, abs=1e-9)


@pytest.mark.parametrize(
    ("speed", "spin_rate", "parabola"),
    [
        (2.0, 200.0, -1.852e-7 * 200**2 - 1.296e-4 * 200 + 0.09833),
        (3.5, 250.0, -1.667e-7 * 250**2 - 3.333e-5 * 250 + 0.1000),
        (10.5, 490.0, -2.604e-7 * 490**2 + 3.646e-4 * 490 - 0.02250),
        (13.5, 600.0, -3.571e-7 * 600**2 + 5.357e-4 * 600 - 0.08929),
        (17.0, 700.0, -1.000e-7 * 700**2 + 2.300e-4 * 700 - 0.03750),
    ],
)
def test_from_50_rad_per_s_beyond_it_the_published_parabola_holds(speed, spin_rate, parabola):
    assert full_magnus(speed, spin_rate) == pytest.approx(parabola, abs=1e-9)


def test_halfway_between_them_half_of_their_difference_is_left():
    """13.5 m/s has the largest: at 550 rad/s the line ends at 0.075, the parabola begins at 0.09732."""
    gap = 0.075 - (-3.571e-7 * 550**2 + 5.357e-4 * 550 - 0.08929)
    parabola = -3.571e-7 * 575**2 + 5.357e-4 * 575 - 0.08929

    assert full_magnus(13.5, 575.0) == pytest.approx(parabola + gap / 2, abs=1e-9)
