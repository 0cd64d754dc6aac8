"""Episodes: how they end and continue, and where the robot starts."""

import numpy as np
import pytest

from common.env.rally_env import EnvStep, RallyEnv
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
from common.task.observation import OBSERVATION, offsets
from common.task.randomization import RallyParameter
from common.task.states import Outcome, State
from tests.unit.env.rallies import PLAYED_OUT, QUIET, Deck, drop_on, hold, make_env, play_until_end
from tests.unit.physics.contacts import as_vec

AT = offsets(OBSERVATION)


def rounds(count: int) -> TaskConfig:
    return QUIET.model_copy(update={"rounds": count})


def test_the_time_limit_truncates_and_the_final_observation_has_the_ball_at_that_time():
    env = make_env(1, QUIET.model_copy(update={"time_limit_s": 0.2}))
    env.reset()
    for _ in range(9):
        assert env.step(hold(env)).ended.size == 0
    launch = env._source.block.launches[0]
    p, v, _, _, _ = fly_to_touch(
        as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9]), 0.2, Air(1, 1, FULL), NO_ROBOT
    )
    step = env.step(hold(env))

    assert step.truncated[0]
    assert not step.terminated[0]
    assert step.finished.outcomes[0] == Outcome.TIME_OUT
    np.testing.assert_array_equal(step.final_obs[0, AT["ball_pos"]], np.float32(p))
    np.testing.assert_array_equal(step.final_obs[0, AT["ball_vel"]], np.float32(v))
    np.testing.assert_array_equal(step.obs[0, AT["ball_pos"]], np.float32(env._source.block.launches[1, :3]))


def test_a_rally_that_ends_by_its_rules_terminates_and_is_not_truncated():
    env = make_env(1)
    env.reset()
    step = play_until_end(env)

    assert step.terminated[0]
    assert not step.truncated[0]
    np.testing.assert_array_equal(step.ended, [0])


def test_a_returned_rally_ends_the_episode_by_default():
    env = make_env(1)
    env.reset()
    drop_on(env, 0.7)
    step = play_until_end(env)

    assert step.terminated[0]
    assert step.finished.outcomes[0] == Outcome.RETURNED
    assert step.finished.landing_errors[0] == pytest.approx(
        np.hypot(0.7 - target_of(step)[0], 0.1 - target_of(step)[1]), rel=1e-5
    )


def target_of(step: EnvStep) -> np.ndarray:
    return step.finished.parameters[0, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]]


@pytest.mark.parametrize(
    ("task", "experience"),
    [(rounds(2), PLAYED_OUT), (QUIET, PLAYED_OUT.model_copy(update={"continue_share": 1.0}))],
    ids=["rounds", "continues"],
)
def test_after_a_return_the_next_rally_begins_with_the_robot_where_it_is(task, experience):
    env = make_env(1, task, experience)
    env.reset()
    swing = env.home_action + np.float32(0.2)
    for _ in range(5):
        env.step(swing[None])
    drop_on(env, 0.7)
    step = env.step(swing[None])
    while not step.finished.rows.size:
        before = env.robot.joint_pos.copy()
        step = env.step(swing[None])

    assert step.finished.outcomes[0] == Outcome.RETURNED
    assert step.ended.size == 0
    assert not step.terminated[0]
    assert not step.truncated[0]
    assert env.rallies.state[0] == State.TAU_0
    # the robot starts where it was, and not at home
    np.testing.assert_allclose(env.robot.joint_pos, before, atol=0.1)
    assert np.abs(env.robot.joint_pos[0] - env.robot.home).max() > 0.1
    np.testing.assert_array_equal(step.obs[0, AT["ball_pos"]], np.float32(env._source.block.launches[1, :3]))


def test_the_last_round_of_an_episode_terminates():
    env = make_env(1, rounds(2))
    env.reset()
    ends = []
    for _ in range(2):
        drop_on(env, 0.7)
        ends.append(bool(play_until_end(env).terminated[0]))

    assert ends == [False, True]


def test_rallies_are_numbered_within_their_episode():
    env = make_env(1, rounds(3))
    env.reset()
    numbers = []
    for is_returned in (True, True, True, True, False, False):
        if is_returned:
            drop_on(env, 0.7)
        numbers.append(int(play_until_end(env).finished.rounds[0]))

    assert numbers == [1, 2, 3, 1, 2, 1]


def test_a_lost_rally_ends_an_episode_of_many_rounds():
    env = make_env(1, rounds(10))
    env.reset()

    assert play_until_end(env).terminated[0]


def test_the_rewards_of_a_rally_add_up_to_its_return():
    env = make_env(1)
    env.reset()
    rewards = []
    while True:
        step = env.step(hold(env))
        rewards.append(step.reward[0])
        if step.ended.size:
            break

    assert step.finished.returns[0] == pytest.approx(sum(rewards), rel=1e-5)
    assert step.finished.lengths[0] == len(rewards)


@pytest.mark.parametrize("validated", [True, False])
def test_a_finished_rally_says_whether_it_was_validated(validated):
    env = RallyEnv(2, QUIET, Deck(draw_rallies(8, seed=1), validated=validated), experience=PLAYED_OUT)
    env.reset()

    np.testing.assert_array_equal(env.validated, [validated] * 2)
    np.testing.assert_array_equal(play_until_end(env).finished.validated, validated)


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0.0, 0.0), (0.5, 0.35, 0.65), (1.0, 1.0, 1.0)])
def test_the_share_carry_over_of_episodes_begins_where_the_last_stroke_left_the_robot(share, low, high):
    env = make_env(32, QUIET.model_copy(update={"carry_over": share}), rallies=400)
    env.reset()
    aside = hold(env)
    aside[:, 1] = 0.5  # far from home at the end of every rally
    stayed = []
    for _ in range(160):
        step = env.step(aside)
        stayed.extend(np.abs(env.robot.joint_pos[step.ended, 1]) > 0.1)

    # about 100 resets: 0.35 to 0.65 are three standard errors
    assert len(stayed) >= 90
    assert low <= np.mean(stayed) <= high


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_no_robot_meets_its_next_ball_in_the_mid_swing_of_an_episode_that_was_cut_at_its_hit(share):
    experience = PLAYED_OUT.model_copy(update={"end_at_hit_share": share})
    env = make_env(2, QUIET.model_copy(update={"carry_over": 1.0}), experience)
    env.reset()
    aside = hold(env)
    aside[:, 1] = 0.5
    for _ in range(10):
        env.step(aside)
    drop_on(env, 0.7, row=0)
    left: dict[int, float] = {}  # how far from home each row's next episode begins
    while len(left) < 2:
        step = env.step(aside)
        for row in step.ended:
            left.setdefault(int(row), np.abs(env.robot.joint_pos[row, 1] - env.robot.home[1]))

    # row 0 hit its ball and row 1 missed it: that rally was played to its end
    assert left[1] > 0.1
    assert left[0] == 0.0 if share else left[0] > 0.1


def test_robots_that_start_at_home_are_within_the_reset_spread():
    env = make_env(64, QUIET.model_copy(update={"reset_spread": 0.1}), rallies=64)
    env.reset()
    offset = env.robot.joint_pos - env.robot.home

    assert np.abs(offset).max() <= 0.1
    assert np.abs(offset).max() > 0.09
