"""Unplayed flights: against parabolas, which can be calculated by hand, and against the environment."""

import numpy as np
import pytest

from common.env.rally_env import RallyEnv
from common.evaluation.unplayed_flight import ARRIVAL_X, unplayed_flight
from common.physics.constants import BALL_RADIUS, GRAVITY
from common.physics.flight_model import Flight
from common.physics.table_bounce import table_bounce
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
from common.task.randomization import RALLY_PARAMETERS
from common.task.states import State
from tests.unit.env.rallies import QUIET, Deck

NAN = float("nan")


def fly(pos, vel, spin=(0.0, 0.0, 0.0)):
    """Return bounce and arrival of a ball without drag and lift, on a table with e_0 0.98 and mu 0.25."""
    parameters = np.zeros((1, RALLY_PARAMETERS))
    parameters[0, 2:4] = 0.98, 0.25
    bounces, arrivals = unplayed_flight(
        np.array([[*pos, *vel, *spin, 0.0, 0.0, 0.0]]), parameters, Flight.SIMPLE
    )
    return bounces[0], arrivals[0]


def test_without_air_bounce_and_arrival_are_where_parabolas_end():
    spin = (10.0, -60.0, 30.0)
    bounce, arrival = fly((1.0, 0.1, 0.3), (-5.0, 0.2, 1.0), spin)

    # z(t) = 0.3 + t - g t^2/2 = r
    fall = (1.0 + np.sqrt(1.0 + 2 * GRAVITY * (0.3 - BALL_RADIUS))) / GRAVITY
    np.testing.assert_allclose(bounce, (1.0 - 5.0 * fall, 0.1 + 0.2 * fall, BALL_RADIUS), atol=1e-9)
    (vx, vy, vz), _ = table_bounce((-5.0, 0.2, 1.0 - GRAVITY * fall), spin, (0.0, 0.0, 1.0), 0.98, 0.25)
    flown = (ARRIVAL_X - bounce[0]) / vx
    height = BALL_RADIUS + vz * flown - GRAVITY * flown**2 / 2
    np.testing.assert_allclose(arrival, (ARRIVAL_X, bounce[1] + vy * flown, height), atol=1e-9)


@pytest.mark.parametrize(
    ("pos", "vel"),
    [
        ((1.0, 0.0, 0.1), (-5.0, 0.0, 0.0)),  # into the net
        ((1.0, 0.0, 0.8), (-1.0, 0.0, 0.0)),  # onto the opponent's court
        ((1.0, 0.0, 0.8), (-9.0, 0.0, 1.0)),  # past the table
    ],
)
def test_a_ball_that_does_not_reach_the_robots_court_has_neither(pos, vel):
    bounce, arrival = fly(pos, vel)

    np.testing.assert_array_equal(bounce, [NAN] * 3)
    np.testing.assert_array_equal(arrival, [NAN] * 3)


def test_a_ball_that_bounces_twice_never_arrives():
    bounce, arrival = fly((0.3, 0.0, 0.3), (-2.0, 0.0, 0.0))

    assert -0.5 < bounce[0] < 0.0
    np.testing.assert_array_equal(arrival, [NAN] * 3)


def test_the_environments_balls_bounce_there():
    block = draw_rallies(16, TaskConfig(randomization="standard"), seed=3)
    config: TaskConfig = QUIET.model_copy(update={"randomization": "standard", "control_rate_hz": 200})
    env = RallyEnv(16, config, Deck(block))
    env.reset()
    expected, _ = unplayed_flight(block.launches, env.rallies.parameters, Flight.FULL)
    found = np.full((16, 3), NAN)
    before = env.rallies.ball[:, :3].copy()
    for _ in range(120):
        flying = np.isin(env.rallies.state, (State.TAU_0, State.TAU_01)) & np.isnan(found[:, 0])
        env.step(np.tile(env.home_action, (16, 1)))
        bounced = flying & (env.rallies.state == State.TAU_12)
        found[bounced] = before[bounced]
        before = env.rallies.ball[:, :3].copy()

    reached = ~np.isnan(found[:, 0])
    assert reached.sum() > 8  # some touch the robot first
    # within the distance of one control step of 5 ms at 9 m/s
    np.testing.assert_allclose(found[reached], expected[reached], atol=0.05)
