"""The observation on a robot equals the simulator's, number by number."""

from pathlib import Path

import numpy as np
import pytest

import topspin
from common.env.rally_env import RallyEnv
from common.perception.camera import DETECTION_BUFFER
from common.perception.camera_filter import is_guess
from common.physics.constants import GRID_STEP
from common.policy.folder import load_policy
from common.rally.observer import BallSample, Observer
from common.robot.chain_of import chain_of
from common.robot.description import describe
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
from common.task.observation import ObservationConfig, policy_layout, size
from common.task.randomization import RallyParameter, profile_of
from tests.unit.env.rallies import PLAYED_OUT, Deck, random_actions

CHAIN = chain_of("rails")

POLICIES = Path(__file__).parents[3] / "common" / "policies"


def ball_of(env: RallyEnv, launched: float) -> BallSample:
    """Return the measurement of row 0, on a clock that showed ``launched`` at the launch."""
    measured, camera_state = env.rallies.measurement[0], env.rallies.camera_state
    guess = len(camera_state) > 0 and bool(is_guess(camera_state[0, DETECTION_BUFFER:]))
    return BallSample(
        tuple(measured[:3]), tuple(measured[3:6]), int(measured[6]), launched + measured[7], guess
    )


def target_of(env: RallyEnv) -> tuple[float, float]:
    return tuple(env.rallies.parameters[0, [RallyParameter.TARGET_X, RallyParameter.TARGET_Y]])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"history": 2},
        {"spin": "hidden", "prediction": False, "age": False},
        {"ball": "filtered", "spin": "hidden", "prediction": False, "age": False},
        {"expected_spin": "strong", "history": 1, "age": False},
        {"expected_spin": "learnt"},
    ],
)
@pytest.mark.parametrize("perception", ["cheap", "full"])
@pytest.mark.parametrize("launched", [100.0, -100.0])
def test_an_observer_returns_the_simulators_observation(options, perception, launched):
    options = ObservationConfig(critic="policy", **options)
    task = TaskConfig(observation=options, perception=perception)
    env = RallyEnv(1, task, Deck(draw_rallies(6, seed=2)), experience=PLAYED_OUT)
    observer = Observer(options, CHAIN)
    obs, rallies, states = env.reset(), 0, set()
    observer.begin(target_of(env))
    for action in random_actions(env, 160, spread=0.1):
        now = launched + env.rallies.clock[0] * GRID_STEP
        own = observer.observe(now, env.robot.joint_pos[0], env.robot.joint_vel[0], ball_of(env, launched))
        np.testing.assert_allclose(own, obs[0], atol=1e-5)
        states.add(int(env.rallies.measurement[0, 6]))
        step = env.step(action)
        obs = step.obs
        if step.ended.size:
            rallies += 1
            observer.begin(target_of(env))

    assert rallies >= 2
    assert {0, 1} <= states


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_policy_in_the_box_acts_on_an_observation(name):
    policy = load_policy(POLICIES / name)
    observer = Observer(policy.contract.task.observation, CHAIN)
    observer.begin((0.7, 0.2))
    still = np.array([joint.home for joint in describe("rails").joint]), np.zeros(7)
    obs = observer.observe(0.02, *still, BallSample((1.0, 0.2, 0.3), (-6.0, 0.5, 1.0), 0, 0.0))
    action = policy.act(obs[None])[0]

    assert obs.shape == (size(policy_layout(policy.contract.task.observation)),)
    assert action.shape == (7,)
    assert np.isfinite(action).all()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"joint_pos": [0.0] * 6 + [np.nan]}, r"joint_pos\[6\] is nan; allowed: a finite number"),
        ({"joint_vel": [np.inf] + [0.0] * 6}, r"joint_vel\[0\] is inf"),
        ({"joint_vel": [0.0] * 6}, "joint_vel has 6 numbers; allowed: 7"),
        ({"now": np.nan}, r"now\[0\] is nan"),
        ({"pos": (1.0, np.nan, 0.3)}, r"ball.pos\[1\] is nan"),
        ({"vel": (1.0, 0.0, -np.inf)}, r"ball.vel\[2\] is -inf"),
        ({"moment": np.nan}, r"ball.moment\[0\] is nan"),
        ({"state": 7}, "ball.state is 7; allowed: 0, 1, 2, 3, 4"),
    ],
)
def test_a_bad_measurement_is_refused_by_name_and_leaves_no_trace(change, line):
    ball = {"pos": (1.0, 0.2, 0.3), "vel": (-6.0, 0.5, 1.0), "state": 0, "moment": 0.0}
    robot = {"now": 0.02, "joint_pos": [0.1] * 7, "joint_vel": [0.0] * 7}
    bad_robot = {name: change.get(name, value) for name, value in robot.items()}
    bad_ball = {name: change.get(name, value) for name, value in ball.items()}
    spoilt, clean = (Observer(ObservationConfig(critic="policy"), CHAIN) for _ in range(2))

    with pytest.raises(ValueError, match=line):
        spoilt.observe(**bad_robot, ball=BallSample(**bad_ball))
    for observer in (spoilt, clean):
        observer.begin((0.7, 0.2))
    np.testing.assert_array_equal(
        spoilt.observe(**robot, ball=BallSample(**ball)), clean.observe(**robot, ball=BallSample(**ball))
    )


@pytest.mark.parametrize(("column", "name"), [(3, r"joint_pos\[3\]"), (40, r"present_ball_pos\[0\]")])
def test_a_policy_refuses_an_observation_that_is_not_finite_by_name(column, name):
    policy, obs = load_policy(POLICIES / "default"), np.zeros((2, 54), np.float32)
    obs[1, column] = np.nan

    with pytest.raises(ValueError, match=rf"observation 1: {name} is nan; allowed: a finite number"):
        policy.act(obs)


def test_without_a_ball_there_is_nothing_to_observe():
    with pytest.raises(ValueError, match="ball is None; allowed: the newest sample"):
        Observer(ObservationConfig(critic="policy"), CHAIN).observe(0.0, [0.0] * 7, [0.0] * 7, None)


@pytest.mark.parametrize("shape", [(1, 37), (54,)])
def test_a_policy_names_the_shape_that_it_needs(shape):
    with pytest.raises(
        ValueError, match=r"obs has shape .*; allowed: \(B, 54\), as an environment gives it with"
    ):
        load_policy(POLICIES / "default").act(np.zeros(shape, np.float32))


def test_a_policy_that_observes_the_true_spin_is_refused():
    with pytest.raises(ValueError, match=r"spin 'true' can't be measured"):
        Observer(ObservationConfig(spin="true"), CHAIN)


@pytest.mark.parametrize("randomization", ["off", "standard", "hard"])
def test_a_robots_observer_assumes_the_noise_of_its_policys_training(randomization):
    profile = profile_of(randomization)
    found = topspin.Observer(TaskConfig(randomization=randomization))

    assert found._noise == (profile.position_noise, profile.velocity_noise)
    assert topspin.Observer(TaskConfig(randomization=randomization), 0.004, 0.2)._noise == (0.004, 0.2)
