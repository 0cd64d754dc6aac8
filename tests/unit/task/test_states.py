"""The rules: the table is complete, and a scripted ball reaches every outcome."""

import numpy as np
import pytest

from common.physics.chain import racket_pose
from common.physics.touch import Touch
from common.rally.state import Rallies
from common.rally.step import play_step
from common.robot.chain_of import chain_of
from common.task.randomization import PROFILES
from common.task.states import (
    CONTINUES_AS,
    OUTCOME_OFFSET,
    TRANSITIONS,
    Outcome,
    State,
    transition_table,
)
from tests.unit.physics.contacts import as_vec, mirrored, mirrored_spin
from tests.unit.rally.scripted import (
    AWAY,
    HOME,
    Played,
    begin,
    make_launch,
    make_motion,
    make_rules,
    play_ball,
)

CHAIN = chain_of("rails")

FACE_UP = (0.0, 0.0, 0.0, 0.3, 0.6, np.pi / 2 - 0.9, 0.0)
FACE_UP_CENTRE = racket_pose(CHAIN, FACE_UP).centre


def forward(speed: float, moment: float) -> dict[str, tuple[float, ...]]:
    """Return a robot that moves towards the opponent and is at home at ``moment`` [s]."""
    return {"joints": (-speed * moment, *HOME[1:]), "rates": (speed, *[0.0] * 6)}


def hit(ball_speed: float, racket_speed: float) -> Played:
    """Play a bounced ball that meets the centre of the vertical racket about 0.03 s from now."""
    return play_ball(
        (-0.75, 0, 0.23), (-ball_speed, 0, 0.5), state=State.TAU_12, **forward(racket_speed, 0.03)
    )


SCRIPTS = {
    Outcome.RETURNED: lambda: hit(8.0, 1.0),
    Outcome.NET: lambda: hit(8.0, 0.0),
    Outcome.OUT: lambda: hit(8.0, 6.0),
    Outcome.OWN_COURT: lambda: hit(3.0, 0.0),
    # falls 15 mm beyond the end line of the table
    Outcome.EDGE: lambda: play_ball((1.385, 0, 0.3), (0, 0, 0), state=State.TAU_23),
    # bounces on a horizontal racket
    Outcome.DOUBLE_HIT: lambda: play_ball(
        (FACE_UP_CENTRE[0], 0, FACE_UP_CENTRE[2] + 0.3), (0, 0, 0), state=State.TAU_12, joints=FACE_UP
    ),
    # falls on the beam
    Outcome.BODY: lambda: play_ball((-1.3, 0.8, 0.4), (-1, 0, -1.5), state=State.TAU_12, joints=HOME),
    Outcome.VOLLEY: lambda: play_ball((-0.75, 0, 0.23), (-8, 0, 0.5), joints=HOME),
    Outcome.DOUBLE_BOUNCE: lambda: play_ball((-0.3, 0, 0.3), (-1, 0, 0)),
    Outcome.MISS: lambda: play_ball((-0.5, 0.3, 0.3), (-6, 1, -2)),
    Outcome.BAD_LAUNCH: lambda: play_ball((0.7, 0, 0.3), (-1, 0, 0)),
    Outcome.TIME_OUT: lambda: play_ball((1, 0, 0.3), (-4, 0, 2), rules=make_rules(time_limit=0.1)),
}


def test_the_table_has_every_touch_in_every_continuing_state():
    assert set(TRANSITIONS) == set(CONTINUES_AS.values())
    assert all(set(row) == set(Touch) for row in TRANSITIONS.values())
    assert np.all(transition_table() >= 0)


@pytest.mark.parametrize(("instant", "continuing"), CONTINUES_AS.items())
def test_an_instant_has_the_rules_of_the_state_that_continues_it(instant, continuing):
    table = transition_table()

    np.testing.assert_array_equal(table[instant], table[continuing])


def test_only_legal_touches_advance_a_rally_and_only_to_the_next_state():
    advances = {
        (state, touch, following)
        for state, row in TRANSITIONS.items()
        for touch, following in row.items()
        if isinstance(following, State) and touch != Touch.NONE
    }

    assert advances == {
        (State.TAU_S0, Touch.OPPONENT_COURT, State.TAU_0),
        (State.TAU_01, Touch.ROBOT_COURT, State.TAU_1),
        (State.TAU_12, Touch.RACKET, State.TAU_2),
        (State.TAU_23, Touch.OPPONENT_COURT, State.TAU_3),
    }


def test_outcomes_and_states_have_different_numbers_in_the_kernels_table():
    table = transition_table()

    assert np.all((table < len(State)) | (table > OUTCOME_OFFSET))


def test_every_outcome_has_a_script():
    assert set(SCRIPTS) == set(Outcome) - {Outcome.NONE}


@pytest.mark.parametrize("outcome", SCRIPTS, ids=lambda outcome: outcome.name)
def test_a_scripted_ball_reaches_each_outcome(outcome):
    assert SCRIPTS[outcome]().outcome == outcome


@pytest.mark.parametrize(
    "outcome",
    [Outcome.RETURNED, Outcome.NET, Outcome.OUT, Outcome.OWN_COURT, Outcome.DOUBLE_HIT],
    ids=lambda outcome: outcome.name,
)
def test_a_legal_racket_contact_counts_as_caught(outcome):
    assert SCRIPTS[outcome]().caught


@pytest.mark.parametrize(
    "outcome",
    [
        Outcome.VOLLEY,
        Outcome.DOUBLE_BOUNCE,
        Outcome.MISS,
        Outcome.BODY,
        Outcome.BAD_LAUNCH,  # these two balls are on the opponent's side
        Outcome.TIME_OUT,
    ],
    ids=lambda o: o.name,
)
def test_without_a_legal_racket_contact_a_ball_is_neither_caught_nor_over(outcome):
    played = SCRIPTS[outcome]()

    assert not played.caught
    assert not played.over
    assert np.isnan(played.landing_error)


@pytest.mark.parametrize(
    ("outcome", "over"), [(Outcome.RETURNED, True), (Outcome.OUT, True), (Outcome.NET, False)]
)
def test_over_means_that_the_ball_crosses_the_net_after_the_catch(outcome, over):
    assert SCRIPTS[outcome]().over == over


def test_a_returned_rally_passes_through_its_states_in_order():
    """Launch over the net, bounce, racket contact, landing: the paper's loop."""
    played = play_ball((0.5, 0, 0.35), (-4.6, 0, 0), **forward(1.0, 0.35))
    order = list(dict.fromkeys(played.states))

    assert played.outcome == Outcome.RETURNED
    assert order == [State.TAU_01, State.TAU_12, State.TAU_23, State.TAU_30]


def test_with_rounds_left_a_rally_continues_after_its_landing_until_the_next_touch():
    rallies, step = begin(make_launch((0.7, 0, 0.3), (0, 0, 0)), State.TAU_23)
    rallies.rounds_left[0] = 2
    found = []
    for _ in range(100):
        play_step(rallies, make_motion(AWAY, AWAY), np.zeros((1, 7)), make_rules(), PROFILES["off"], step)
        found.append((State(int(rallies.state[0])), Outcome(int(step.outcome[0]))))
        if step.outcome[0]:
            break

    assert (State.TAU_30, Outcome.NONE) in found
    assert found[-1][1] == Outcome.RETURNED


def test_a_landed_ball_is_returned_even_if_the_time_limit_comes_before_its_next_touch():
    rallies, step = begin(make_launch((0.7, 0, 0.1), (0, 0, 0)), State.TAU_23)
    rallies.rounds_left[0] = 2
    rules = make_rules(time_limit=0.2)
    for _ in range(10):
        play_step(rallies, make_motion(AWAY, AWAY), np.zeros((1, 7)), rules, PROFILES["off"], step)

    assert rallies.state[0] == State.TAU_30
    assert step.outcome[0] == Outcome.RETURNED


def test_a_racket_that_moves_away_faster_than_the_ball_does_not_touch_it():
    played = play_ball(
        (-1.03, 0, 0.23), (-2, 0, 0.5), state=State.TAU_12, joints=HOME, rates=(-6, *[0.0] * 6), steps=3
    )

    assert played.outcome == Outcome.NONE
    assert not played.caught


def touched_by_a_racket_that_starts_to_move(ball_speed: float) -> Rallies:
    """Play 5 ms in which the racket is at rest for 10 us, and then moves at 10 m/s towards a ball 1 mm inside it.

    The search for a touch looks 20 us ahead and finds a gap that closes. At the touch itself the racket is at rest.
    """
    centre = racket_pose(CHAIN, HOME).centre
    inside = centre[0] + 0.0065 + 0.020 - 0.001
    rallies, step = begin(make_launch((inside, centre[1], centre[2]), (ball_speed, 0, 0)), State.TAU_12)
    pause = 1e-5
    joints = np.tile(np.array(HOME), (500, 1))
    joints[:, 0] += 10.0 * pause * np.arange(500)
    motion = make_motion(HOME, HOME)._replace(
        joint_pos=joints[None], torque=np.zeros((1, 500, 7)), contact=np.zeros((1, 500, 4)), step=pause
    )
    rules = make_rules()._replace(grid_steps=1)
    play_step(rallies, motion, np.zeros((1, 7)), rules, PROFILES["off"], step)
    return rallies


def test_a_touch_without_approach_is_no_contact():
    leaving = touched_by_a_racket_that_starts_to_move(0.5)

    assert leaving.state[0] == State.TAU_12
    assert not leaving.caught[0]
    np.testing.assert_array_equal(leaving.ball[0, 3:6], [0.5, 0.0, 0.0])


def test_the_same_touch_with_approach_is_a_contact():
    coming = touched_by_a_racket_that_starts_to_move(-0.5)

    assert coming.caught[0]
    assert coming.ball[0, 3] > 0.0


def test_the_mirror_image_of_a_rally_is_played_as_its_mirror_image():
    flip = np.array([1, -1, -1, 1, 1, 1, -1])
    rates = np.array([1.0, -0.2, 0.5, 0.0, 0.0, 0.5, 0.4])
    joints = np.array([0.0, 0.0, 0.1, 1.0, 1.0, 1.1, -0.2]) - 0.35 * rates
    pos, vel, spin = (0.5, 0.1, 0.35), (-4.6, -0.2, 0.0), (20.0, -60.0, 30.0)
    played = play_ball(pos, vel, spin, joints=joints, rates=rates, drag=1.0, lift=1.0)
    image = play_ball(
        mirrored(pos),
        mirrored(vel),
        mirrored_spin(spin),
        joints=flip * joints,
        rates=flip * rates,
        drag=1.0,
        lift=1.0,
    )

    assert played.caught
    assert (image.outcome, image.states) == (played.outcome, played.states)
    for ball, mirror_ball in zip(played.balls, image.balls, strict=True):
        expected = [
            *mirrored(as_vec(ball[:3])),
            *mirrored(as_vec(ball[3:6])),
            *mirrored_spin(as_vec(ball[6:])),
        ]
        # only rounding: sines of mirrored angles are mirrored exactly, but sums may have another order
        np.testing.assert_allclose(mirror_ball, expected, rtol=0, atol=1e-10)
