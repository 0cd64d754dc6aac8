"""Heading: where a hit ball comes down, against a flight in small steps."""

import numpy as np

from common.physics.constants import NET_HEIGHT
from common.physics.flight import SIMPLE, flight_step
from common.rally.heading import NOT_THAT_FAR, heading
from tests.unit.rally.scripted import begin, make_record


def condition_of(seed=1):
    rallies, _ = begin(make_record((0, 0, 1), (0, 0, 0), drag=1.0, lift=1.0), seed=seed)
    return rallies.condition[0]


def test_a_heading_is_where_small_steps_come_down():
    condition = condition_of()
    pos, vel, spin = (-1.0, 0.1, 0.3), (4.0, 0.5, 2.0), (10.0, 80.0, -20.0)
    p, v, over = pos, vel, NOT_THAT_FAR
    while not (p[2] < 0.020 and v[2] < 0):
        before = p
        p, v = flight_step(p, v, spin, 1e-4, condition[0], condition[1], SIMPLE)
        if before[0] < 0 <= p[0]:
            over = p[2] - NET_HEIGHT - 0.020

    np.testing.assert_allclose(heading(pos, vel, spin, condition, SIMPLE), (p[0], p[1], over), atol=1e-3)


def test_a_ball_that_comes_back_before_the_net_never_clears_it():
    _, _, over_net = heading((-1.0, 0.0, 0.3), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), condition_of(), SIMPLE)

    assert over_net == NOT_THAT_FAR
