"""The reward: R as in the paper, e_r as a penalty, and how instants and rates are paid."""

import numpy as np
import pytest

from common.physics.chain import racket_pose
from common.rally.step import play_step
from common.robot.chain_of import chain_of
from common.task.config import RewardConfig
from common.task.randomization import PROFILES
from common.task.reward import FEATURES, TERMS, R, reward_table
from common.task.states import Outcome, State
from tests.unit.rally.scripted import AWAY, HOME, begin, make_launch, make_motion, make_rules, play_ball

CHAIN = chain_of("rails")

# The paper's matrix as it is printed, with leading zeros: rows tau_0 .. tau_30, columns stage 1 .. 3
PRINTED = """
    0   | 0     | 0
    1g  | 0.25g | 0.1g
    10  | 4     | 1
    1g  | 0.25g | 0.1g
    25  | 50+v  | 10
    0   | 0     | b
    0   | 0     | 30+40l
    0   | 0     | 0
"""
SYMBOLS = {"g": "g", "v": "speed", "b": "aim", "l": "landing"}
LOW = (0.013, 0.0, 0.0, 1.571, 0.582, np.pi - 2.153, 0.0)
"""The racket is vertical and stands on the table: centre at x = -1.05, z = 0.08."""


def parsed(entry: str) -> list[float]:
    """Return an entry's weights in the order of FEATURES."""
    weights = dict.fromkeys(FEATURES, 0.0)
    for term in entry.strip().split("+"):
        name = SYMBOLS.get(term[-1], "constant")
        number = term if name == "constant" else term[:-1]
        weights[name] += float(number or 1.0)
    return list(weights.values())


def pay(
    stage: int = 1, rate_scale: float = 1.0, action: float = 0.0, **forces: np.ndarray
) -> dict[str, float]:
    """Return the terms of one control step of a ball on its way to a robot at rest."""
    rallies, step = begin(make_launch((0.7, 0, 0.6), (-1, 0, 0)))
    actions = np.zeros((1, 7))
    actions[0, :2] = action
    rules = make_rules(stage, rate_scale)
    motion = make_motion(HOME, HOME)._replace(**forces)
    play_step(rallies, motion, actions, rules, PROFILES["off"], step)
    assert step.reward[0] == pytest.approx(step.terms[0].sum())
    return dict(zip(TERMS, step.terms[0], strict=True))


def hit(racket_speed: float, stage: int) -> dict[str, float]:
    """Return the sums of the terms of a bounced ball that meets a racket moving along x."""
    joints = (-0.03 * racket_speed, *HOME[1:])
    played = play_ball(
        (-0.75, 0, 0.23),
        (-8, 0, 0.3),
        state=State.TAU_12,
        joints=joints,
        rates=(racket_speed, *[0.0] * 6),
        rules=make_rules(stage),
    )
    return dict(zip(TERMS, played.terms.sum(axis=0), strict=True))


def test_the_matrix_is_the_papers():
    rows = [[parsed(entry) for entry in row.split("|")] for row in PRINTED.strip().splitlines()]

    np.testing.assert_array_equal(reward_table()[:, :8], np.swapaxes(rows, 0, 1))


def test_a_serve_is_paid_as_a_ball_that_comes():
    table = reward_table()

    np.testing.assert_array_equal(table[:, State.TAU_S], table[:, State.TAU_0])
    np.testing.assert_array_equal(table[:, State.TAU_S0], table[:, State.TAU_01])


def test_the_matrix_has_an_entry_for_every_state_stage_and_feature():
    assert set(R) == set(State)
    assert {len(columns) for columns in R.values()} == {3}
    assert {len(entry) for columns in R.values() for entry in columns} == {len(FEATURES)}


@pytest.mark.parametrize(("stage", "weight"), [(1, 1.0), (2, 0.25), (3, 0.1)])
def test_the_approach_is_paid_by_the_distance_of_racket_and_ball(stage, weight):
    """The ball falls for 20 ms at 1 m/s and the racket is at home: d_rb follows from their coordinates."""
    ball = np.array([0.7 - 0.02, 0.0, 0.6 - 9.81 / 2 * 0.02**2])
    d_rb = np.linalg.norm(ball - racket_pose(CHAIN, HOME).centre)

    assert pay(stage)["catch_approach"] == pytest.approx(weight / (1 + d_rb**2) ** 2)


def test_the_torque_penalty_is_the_share_of_the_limit():
    torque = np.zeros((1, 5, 7))
    torque[..., 0], torque[..., 6] = -100.0, 3.0  # a quarter of 400 N, and all of 3 Nm

    assert pay(torque=torque)["torque"] == pytest.approx(-0.02 * 1.25)


def test_the_collision_penalty_of_each_body_grows_up_to_50_newton():
    contact = np.zeros((1, 5, 4))
    contact[..., 0], contact[..., 3] = 25.0, 400.0

    assert pay(contact=contact)["collision"] == pytest.approx(-0.1 * 1.5)


def test_a_contact_of_one_substep_in_five_costs_a_fifth():
    contact = np.zeros((1, 5, 4))
    contact[0, 2, 1] = 50.0

    assert pay(contact=contact)["collision"] == pytest.approx(-0.1 / 5)


def test_the_jitter_penalty_is_the_squared_change_of_the_action():
    assert pay(action=0.5)["jitter"] == pytest.approx(-0.02 * (0.5**2 + 0.5**2))


def test_an_action_that_does_not_change_costs_no_jitter():
    rallies, step = begin(make_launch((0.7, 0, 0.6), (-1, 0, 0)))
    for _ in range(2):
        play_step(rallies, make_motion(AWAY, AWAY), np.ones((1, 7)), make_rules(), PROFILES["off"], step)

    assert step.terms[0, TERMS.index("jitter")] == 0.0


def test_e_r_is_a_penalty_in_every_stage():
    """The paper prints a plus before e_r, with positive coefficients. That would reward jitter."""
    forces = {"torque": np.full((1, 5, 7), 2.0), "contact": np.full((1, 5, 4), 10.0)}
    for stage in (1, 2, 3):
        terms = pay(stage, action=1.0, **forces)

        assert max(terms["torque"], terms["jitter"], terms["collision"]) < 0.0


def test_rewards_by_time_are_scaled_with_the_control_rate_and_jitter_is_not():
    forces = {"torque": np.full((1, 5, 7), 2.0), "contact": np.full((1, 5, 4), 10.0)}
    reference, quarter = pay(action=1.0, **forces), pay(action=1.0, rate_scale=0.25, **forces)

    for rate in ("catch_approach", "torque", "collision"):
        assert quarter[rate] == pytest.approx(0.25 * reference[rate])
    assert quarter["jitter"] == reference["jitter"]


def test_bounce_and_hit_in_one_control_step_are_both_paid():
    """Half-volley: 8 ms to the table, about 5 ms more to the racket that stands on it."""
    played = play_ball((-0.96, 0, 0.06), (-5, 0, -5), joints=LOW, steps=1)

    assert played.states == [State.TAU_23]
    np.testing.assert_array_equal(played.terms[0], [0, 10, 25, 0, 0, 0, 0, 0])


def test_an_instant_is_paid_once_and_replaces_its_steps_continuous_reward():
    played = play_ball((-0.3, 0, 0.3), (-1, 0, 0))
    bounce, approach = played.terms[:, 1], played.terms[:, 0]

    assert np.count_nonzero(bounce) == 1
    assert approach[np.flatnonzero(bounce)[0]] == 0.0


@pytest.mark.parametrize(
    ("racket_speed", "paid"), [(-3.0, 0.0), (2.0, 2.0), (12.0, 10.0)], ids=["back", "forward", "too fast"]
)
def test_stage_2_pays_the_rackets_speed_towards_the_opponent_from_0_to_10(racket_speed, paid):
    assert hit(racket_speed, stage=2)["contact"] == pytest.approx(50.0 + paid)


@pytest.mark.parametrize(("stage", "paid"), [(1, 25.0), (3, 10.0)])
def test_the_rackets_speed_is_not_paid_in_stages_1_and_3(stage, paid):
    assert hit(2.0, stage)["contact"] == pytest.approx(paid)


def test_a_landing_half_a_metre_off_pays_30_plus_40_divided_by_1_25_squared():
    played = play_ball(
        (0.7, 0.1, 0.3), (0, 0, 0), state=State.TAU_23, target=(0.7, 0.6), rules=make_rules(stage=3)
    )

    assert played.outcome == Outcome.RETURNED
    assert played.landing_error == pytest.approx(0.5)
    assert played.terms[-1, TERMS.index("landing")] == pytest.approx(30.0 + 40.0 / 1.25**2)


def test_a_length_scale_makes_the_landing_reward_steeper():
    rules = make_rules(stage=3, reward=RewardConfig(landing_scale=0.25))
    played = play_ball((0.7, 0.1, 0.3), (0, 0, 0), state=State.TAU_23, target=(0.7, 0.6), rules=rules)

    assert played.terms[-1, TERMS.index("landing")] == pytest.approx(30.0 + 40.0 / (1.0 + 4.0) ** 2)


def test_on_its_way_back_the_ball_is_paid_by_its_distance_to_the_target_in_space():
    played = play_ball(
        (0.5, 0.2, 0.8), (0, 0, 0), state=State.TAU_23, target=(0.9, 0.5), rules=make_rules(stage=3), steps=1
    )
    height = 0.8 - 9.81 / 2 * 0.02**2
    # the target is the centre of a ball on the table, at a height of 20 mm
    d_bt = np.sqrt(0.4**2 + 0.3**2 + (height - 0.02) ** 2)

    assert played.terms[0, TERMS.index("aim")] == pytest.approx(1.0 / (1.0 + d_bt**2) ** 2)


BONUS = RewardConfig(landing_scale=1.0, landing_bonus=100.0, landing_bonus_scale=0.5)


@pytest.mark.parametrize(
    ("what", "pos", "vel", "share"),
    [
        ("onto the court", (-1.0, 0.1, 0.3), (3.0, 0.5, 2.0), 1.0),
        ("into the net, and without it onto the court", (-1.0, 0.1, 0.1), (5.0, 0.5, 0.8), 0.5),
        ("past the table", (-1.0, 0.1, 0.3), (7.0, 0.5, 2.0), 1.0),
    ],
)
def test_the_landing_bonus_is_paid_for_the_landing_point_of_a_parabola(what, pos, vel, share):
    target = (0.7, 0.2)
    played = play_ball(pos, vel, state=State.TAU_23, target=target, rules=make_rules(stage=3, reward=BONUS))
    plain = play_ball(pos, vel, state=State.TAU_23, target=target, rules=make_rules(stage=3))

    # The bonus is paid at the end of the first control step, for the ball at that time. It is on the same parabola.
    fall = (vel[2] + np.sqrt(vel[2] ** 2 + 2 * 9.81 * (pos[2] - 0.02))) / 9.81
    e2 = (pos[0] + vel[0] * fall - target[0]) ** 2 + (pos[1] + vel[1] * fall - target[1]) ** 2
    bonus = played.terms[:, TERMS.index("aim")] - plain.terms[:, TERMS.index("aim")]
    assert bonus[0] == pytest.approx(share * 100.0 / (1.0 + e2 / 0.25), rel=1e-3), what
    np.testing.assert_array_equal(bonus[1:], 0.0)


@pytest.mark.parametrize("stage", [1, 2])
def test_the_landing_bonus_is_paid_only_in_stage_3(stage):
    played = play_ball(
        (-1, 0, 0.3), (3, 0, 2), state=State.TAU_23, rules=make_rules(stage=stage, reward=BONUS)
    )

    np.testing.assert_array_equal(played.terms[:, TERMS.index("aim")], 0.0)


@pytest.mark.parametrize(
    ("pos", "vel", "spin", "outcome"),
    [
        ((-1.0, 0.1, 0.3), (3.0, 0.5, 2.0), (0, 90, 20), Outcome.RETURNED),
        ((-1.0, 0.1, 0.1), (5.0, 0.5, 0.9), (0, -20, 0), Outcome.NET),
        ((-1.0, 0.1, 0.3), (8.0, 0.5, 2.0), (0, 0, 50), Outcome.OUT),
        ((-1.0, 0.1, 0.3), (1.0, 0.0, 0.0), (0, 0, 0), Outcome.OWN_COURT),
    ],
)
def test_a_flight_simulated_to_its_landing_has_outcome_and_reward_of_the_played_flight(
    pos, vel, spin, outcome
):
    """The arm is far away: played or simulated at once, it is the same ball, bit for bit."""
    options = {"state": State.TAU_23, "drag": 1.1, "lift": 0.9, "target": (0.7, 0.2)}
    played = play_ball(pos, vel, spin, rules=make_rules(stage=3, reward=BONUS), **options)
    at_once = play_ball(pos, vel, spin, rules=make_rules(stage=3, reward=BONUS), ends_at_hit=True, **options)

    assert played.outcome == at_once.outcome == outcome
    assert len(at_once.rewards) == 1 < len(played.rewards)
    assert at_once.over == played.over
    np.testing.assert_array_equal(at_once.landing_error, played.landing_error)
    for term in ("aim", "landing"):
        k = TERMS.index(term)
        # Continuous rewards are paid at the end of a control step. The step in which the flight ends may differ.
        assert at_once.terms[:, k].sum() == pytest.approx(
            played.terms[:, k].sum(), abs=1.0 if term == "aim" else 1e-9
        )


def test_a_ball_that_is_not_hit_yet_is_played_step_by_step():
    played = play_ball((0.7, 0, 0.6), (-3, 0, 0), ends_at_hit=True)

    assert State.TAU_12 in played.states
    assert played.outcome != Outcome.RETURNED
