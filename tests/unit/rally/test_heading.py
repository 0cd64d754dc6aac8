"""Foresight and heading against playing on: what is foreseen is what comes, if the robot goes on as it moves."""

import numpy as np
import pytest

from common.physics.constants import GRID_STEP, NET_HEIGHT
from common.physics.flight import SIMPLE, flight_step
from common.rally.heading import COARSE_STEP, LOOK_AHEAD, NET_MARGIN, foresight, heading
from common.rally.trajectory import State
from tests.unit.physics.contacts import as_vec
from tests.unit.rally.scripted import HOME, begin, make_record, play_ball

TARGET = (0.7, 0.2)
STROKES = {
    "still": (0.0,) * 7,
    "forward": (2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "swung": (1.0, -0.2, 0.5, -1.0, -0.5, -0.5, 1.0),
}
BALLS = {
    "slow": ((-0.75, 0.0, 0.24), (-3.0, 0.1, 0.5), (0.0, 40.0, 10.0)),
    "fast": ((-0.55, 0.05, 0.20), (-7.0, -0.3, 0.8), (30.0, -80.0, 0.0)),
}


def condition_of(seed=1):
    rallies, _ = begin(make_record((0, 0, 1), (0, 0, 0), drag=1.0, lift=1.0), target=TARGET, seed=seed)
    return rallies.condition[0]


@pytest.mark.parametrize("stroke", STROKES)
@pytest.mark.parametrize("ball", BALLS)
def test_what_is_foreseen_is_what_comes(stroke, ball):
    pos, vel, spin = BALLS[ball]
    rates = STROKES[stroke]
    condition = condition_of()
    seen = foresight(pos, vel, spin, condition, HOME, rates, SIMPLE)
    played = play_ball(
        pos,
        vel,
        spin,
        state=State.TAU_12,
        joints=HOME,
        rates=rates,
        drag=1.0,
        lift=1.0,
        target=TARGET,
        steps=60,
    )
    hit = next(k for k, state in enumerate(played.states) if state == State.TAU_23)
    after = played.balls[hit]
    x, y, over_net = heading(
        as_vec(after[:3]), as_vec(after[3:6]), as_vec(after[6:9]), condition, SIMPLE, GRID_STEP
    )

    assert seen.meets == 1.0
    assert hit * 0.020 - 1e-9 <= seen.time <= (hit + 1) * 0.020
    assert seen.miss_x == pytest.approx(x - TARGET[0], abs=0.03)
    assert seen.miss_y == pytest.approx(y - TARGET[1], abs=0.03)
    assert seen.over_net == pytest.approx(over_net, abs=0.02)


@pytest.mark.parametrize(
    ("what", "pos", "vel"),
    [
        ("too far away", (0.9, 0.0, 0.3), (-3.0, 0.0, 0.0)),
        ("flying off", (-0.75, 0.0, 0.24), (3.0, 0.0, 0.5)),
        ("behind the racket", (-1.3, 0.0, 0.24), (-3.0, 0.0, 0.5)),
    ],
)
def test_what_will_not_meet_is_said_not_to(what, pos, vel):
    seen = foresight(pos, vel, (0.0, 0.0, 0.0), condition_of(), HOME, (0.0,) * 7, SIMPLE)

    assert tuple(seen) == (0.0, LOOK_AHEAD, 0.0, 0.0, 0.0, 0.0, 0.0), what


def test_a_heading_is_where_small_steps_come_down():
    condition = condition_of()
    pos, vel, spin = (-1.0, 0.1, 0.3), (4.0, 0.5, 2.0), (10.0, 80.0, -20.0)
    p, v, over = pos, vel, -NET_MARGIN
    while not (p[2] < 0.020 and v[2] < 0):
        before = p
        p, v = flight_step(p, v, spin, 1e-4, condition[0], condition[1], SIMPLE)
        if before[0] < 0 <= p[0]:
            over = p[2] - NET_HEIGHT - 0.020

    for step in (GRID_STEP, COARSE_STEP):
        x, y, over_net = heading(pos, vel, spin, condition, SIMPLE, step)
        np.testing.assert_allclose((x, y, over_net), (p[0], p[1], over), atol=0.01)


def test_a_ball_that_comes_back_before_the_net_never_clears_it():
    _, _, over_net = heading(
        (-1.0, 0.0, 0.3), (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), condition_of(), SIMPLE, GRID_STEP
    )

    assert over_net == -NET_MARGIN
