"""Predicted landing point: against a flight in small steps."""

import numpy as np

from common.physics.flight import SIMPLE, Air, flight_step
from common.task.landing_point import SHORT_OF_NET, landing_point

AIR = Air(1.0, 1.0, SIMPLE)


def test_the_landing_point_is_that_of_a_flight_in_small_steps():
    pos, vel, spin = (-1.0, 0.1, 0.3), (4.0, 0.5, 2.0), (10.0, 80.0, -20.0)
    p, v, over = pos, vel, SHORT_OF_NET
    while not (p[2] < 0.020 and v[2] < 0):
        before = p
        p, v = flight_step(p, v, spin, 1e-4, AIR)
        if before[0] < 0 <= p[0]:
            over = p[2] - 0.1525 - 0.020

    np.testing.assert_allclose(landing_point(pos, vel, spin, AIR), (p[0], p[1], over), atol=1e-3)


def test_a_ball_that_comes_down_before_the_net_does_not_clear_it():
    _, _, over_net = landing_point((-1.0, 0.0, 0.3), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), AIR)

    assert over_net == SHORT_OF_NET
