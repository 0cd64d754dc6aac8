"""The layouts of observation and action, and the numbers in them."""

import numpy as np
import pytest

from common.env.local_rallies import LocalRallies
from common.env.rally_env import RallyEnv
from common.perception.flight_track import INTERCEPTION, PRESENT, SPIN
from common.physics.chain import racket_motion, racket_pose
from common.physics.constants import GRID_STEP
from common.rally.observe import observation_flags, observe
from common.rally.step import play_step
from common.robot.chain_of import chain_of
from common.task.config import TaskConfig
from common.task.observation import (
    ACTION,
    OBSERVATION,
    PAPER_OBSERVATION,
    PRIVILEGED,
    ObservationConfig,
    critic_layout,
    offsets,
    policy_layout,
    size,
)
from common.task.randomization import PROFILES
from common.task.states import State
from tests.unit.rally.scripted import HOME, begin, make_launch, make_motion, make_rules

CHAIN = chain_of("rails")

AT = offsets(OBSERVATION)
LAUNCH = make_launch((0.7, 0.2, 0.6), (-1, 0.5, 0.1), (10, 20, 30))


def observed(joints=HOME, rates=(0.0,) * 7, state: State = State.TAU_01, launch=LAUNCH) -> np.ndarray:
    """Return the observation after one control step in which the robot moved with ``rates``."""
    rallies, step = begin(launch, state, target=(0.9, -0.3))
    start = np.array(joints) - 0.02 * np.array(rates)
    play_step(rallies, make_motion(start, joints), np.zeros((1, 7)), make_rules(), PROFILES["off"], step)
    out = np.empty((1, 37), np.float32)
    observe(
        rallies,
        np.array([0]),
        np.array([joints]),
        np.array([rates]),
        CHAIN,
        flags=observation_flags(PAPER_OBSERVATION),
        out=out,
    )
    return out[0]


def test_the_observation_has_37_numbers_in_the_papers_order_and_the_action_7():
    assert [(part.name, part.size) for part in OBSERVATION] == [
        ("joint_pos", 7),
        ("joint_vel", 7),
        ("racket_pos", 3),
        ("racket_quat", 4),
        ("racket_vel", 3),
        ("ball_pos", 3),
        ("ball_vel", 3),
        ("target", 2),
        ("trajectory_state", 1),
        ("continuous_state", 4),
    ]
    assert size(OBSERVATION) == 37
    assert size(ACTION) == 7


def test_the_parts_follow_each_other_without_gaps():
    ends = [0, *(part.stop for part in AT.values())]

    assert [part.start for part in AT.values()] == ends[:-1]


def test_joints_and_racket_are_those_of_the_robot():
    joints, rates = (0.1, -0.2, 0.3, 0.9, 1.1, 1.0, -0.4), (1.0, 2.0, -3.0, 0.5, 0.6, -0.7, 4.0)
    obs = observed(joints, rates)

    np.testing.assert_allclose(obs[AT["joint_pos"]], joints, rtol=1e-6)
    np.testing.assert_allclose(obs[AT["joint_vel"]], rates, rtol=1e-6)
    np.testing.assert_allclose(obs[AT["racket_pos"]], racket_pose(CHAIN, joints).centre, rtol=1e-6)
    np.testing.assert_allclose(obs[AT["racket_vel"]], racket_motion(CHAIN, joints, rates)[0], rtol=1e-6)


def test_ball_and_target_are_in_their_parts_of_the_layout():
    obs = observed()
    rallies, step = begin(LAUNCH)
    play_step(rallies, make_motion(HOME, HOME), np.zeros((1, 7)), make_rules(), PROFILES["off"], step)

    np.testing.assert_allclose(obs[AT["ball_pos"]], rallies.ball[0, :3], rtol=1e-6)
    np.testing.assert_allclose(obs[AT["ball_vel"]], rallies.ball[0, 3:6], rtol=1e-6)
    np.testing.assert_allclose(obs[AT["target"]], [0.9, -0.3], rtol=1e-6)


def test_spin_is_not_observed():
    other = make_launch(LAUNCH[:3], LAUNCH[3:6], (-90, 5, 60))

    np.testing.assert_array_equal(observed(), observed(launch=other))


@pytest.mark.parametrize(
    ("state", "number", "one_hot"),
    [
        (State.TAU_01, -1.0, [1, 0, 0, 0]),
        (State.TAU_12, -1 / 3, [0, 1, 0, 0]),
        (State.TAU_23, 1 / 3, [0, 0, 1, 0]),
        (State.TAU_30, 1.0, [0, 0, 0, 1]),
    ],
)
def test_the_trajectory_state_is_a_number_and_one_hot(state, number, one_hot):
    obs = observed(state=state)

    assert obs[AT["trajectory_state"]] == pytest.approx(number)
    np.testing.assert_array_equal(obs[AT["continuous_state"]], one_hot)


def test_the_rackets_frame_is_near_the_identity_at_home():
    np.testing.assert_allclose(observed()[AT["racket_quat"]], [1, 0, 0, 0], atol=0.03)


def test_near_home_the_quaternion_does_not_jump_in_sign():
    """For every pose within 0.6 rad of home in yaw, roll and the racket's pitch, w is far from 0."""
    rng = np.random.default_rng(0)
    joints = np.array(HOME) + rng.uniform(-1, 1, (300, 7)) * [0.5, 0.5, 0.6, 0.2, 0.2, 0.2, 0.6]
    quaternions = np.array([observed(tuple(q))[AT["racket_quat"]] for q in joints])

    assert quaternions[:, 0].min() > 0.7
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("history", [0, 1, 5])
@pytest.mark.parametrize("spin", ["hidden", "estimated", "true"])
@pytest.mark.parametrize("age", [False, True])
@pytest.mark.parametrize("prediction", [False, True])
@pytest.mark.parametrize("critic", ["policy", "privileged"])
def test_options_only_add_numbers_after_the_papers(history, spin, prediction, age, critic):
    config = ObservationConfig(history=history, spin=spin, prediction=prediction, age=age, critic=critic)

    assert policy_layout(config)[: len(OBSERVATION)] == OBSERVATION
    assert critic_layout(config)[: len(policy_layout(config))] == policy_layout(config)
    assert size(policy_layout(config)) == 37 + 3 * (spin != "hidden") + 13 * prediction + age + 6 * history
    assert size(critic_layout(config)) - size(policy_layout(config)) == size(PRIVILEGED) * (
        critic == "privileged"
    )


def played(config, steps=12):
    """Return the observations (steps + 1, D) of one ball, and its true states (steps + 1, 9)."""
    task = TaskConfig(observation=config)
    env = RallyEnv(1, task, LocalRallies(3, task))
    observations, truth = [env.reset()[0]], [env.rallies.ball[0].copy()]
    for _ in range(steps):
        observations.append(env.step(env.robot.home_action[None]).obs[0])
        truth.append(env.rallies.ball[0].copy())
    return np.array(observations), np.array(truth)


def test_the_history_has_the_earlier_measurements_newest_first():
    observations, _ = played(
        ObservationConfig(history=3, spin="hidden", prediction=False, age=False, critic="policy")
    )
    measured = observations[:, 24:30]

    for age in (1, 2, 3):
        earlier = observations[:, 37 + 6 * (age - 1) : 37 + 6 * age]
        np.testing.assert_array_equal(earlier[age:], measured[:-age])
        np.testing.assert_array_equal(earlier[0], measured[0])  # before the launch: the first measurement


def test_spin_estimate_prediction_and_sample_age_follow_the_papers_numbers():
    env = RallyEnv(3, TaskConfig(), LocalRallies(3))
    env.reset()
    at = offsets(policy_layout(TaskConfig().observation))
    ages = []
    for _ in range(12):
        obs = env.step(np.tile(env.home_action, (3, 1))).obs
        rallies = env.rallies
        age = rallies.clock * GRID_STEP - rallies.measurement[:, 7]
        ages.append(obs[:, at["sample_age"]][:, 0])

        np.testing.assert_array_equal(
            obs[:, at["spin_estimate"]], rallies.track[:, SPIN : SPIN + 3].astype(np.float32)
        )
        for name, where in (
            ("present_ball_pos", PRESENT),
            ("present_ball_vel", PRESENT + 3),
            ("interception_in", INTERCEPTION),
            ("interception_ball_pos", INTERCEPTION + 1),
            ("interception_ball_vel", INTERCEPTION + 4),
        ):
            part = obs[:, at[name]]
            np.testing.assert_array_equal(
                part, rallies.track[:, where : where + part.shape[1]].astype(np.float32)
            )
        np.testing.assert_array_equal(ages[-1], age.astype(np.float32))

    assert np.abs(obs[:, at["spin_estimate"]]).max() > 1.0
    assert np.min(ages) >= 0.0099  # the latency is 10 to 40 ms; the age is more where a sample was lost


def test_a_filtered_ball_replaces_the_measured_ball():
    paper = {"spin": "hidden", "prediction": False, "age": False, "critic": "policy"}
    config = ObservationConfig(ball="filtered", **paper)
    filtered, truth = played(config)
    sampled, _ = played(PAPER_OBSERVATION)
    predicted, _ = played(ObservationConfig(critic="policy"))
    at = offsets(policy_layout(ObservationConfig()))
    present = np.r_[at["present_ball_pos"], at["present_ball_vel"]]

    assert size(policy_layout(config)) == 37
    np.testing.assert_array_equal(filtered[:, 24:30], predicted[:, present])
    np.testing.assert_array_equal(np.delete(filtered, np.s_[24:30], 1), np.delete(sampled, np.s_[24:30], 1))
    off, off_sampled = (
        np.linalg.norm(obs[4:, 24:27] - truth[4:, :3], axis=1).max() for obs in (filtered, sampled)
    )
    assert off < 0.02
    assert off_sampled > 0.1
    assert "now" in policy_layout(config)[5].meaning


def test_the_critic_observes_the_truth_after_the_policys_numbers():
    paper, _ = played(PAPER_OBSERVATION)
    privileged, truth = played(ObservationConfig(history=0, spin="true", prediction=False, age=False))

    np.testing.assert_array_equal(privileged[:, :37], paper)
    np.testing.assert_allclose(privileged[:, 37:40], truth[:, 6:9], rtol=1e-6)  # option spin
    np.testing.assert_allclose(privileged[:, 40:49], truth, rtol=1e-6)
    assert np.abs(privileged[3:, 24:27] - truth[3:, :3]).max() > 0.01  # the policy's ball is late and noisy
    assert (privileged[:, 49:57] == privileged[0, 49:57]).all()  # parameters do not change in a rally
