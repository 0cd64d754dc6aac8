"""A robot's own observation is the simulator's, number by number."""

from pathlib import Path

import numpy as np
import pytest

from common.env.rally_env import EnvConfig, RallyEnv
from common.env.robot import JOINTS, RobotBatch
from common.physics.constants import GRID_STEP
from common.policy.weights import load_policy
from common.rally.camera import FILM
from common.rally.estimator import is_guess
from common.rally.launch import draw_rallies
from common.rally.noise import Condition
from common.rally.observation import JOINT_RANGES, ObservationConfig, policy_layout, size
from common.rally.observer import BallSample, Observer
from tests.unit.env.rallies import Deck, random_actions

POLICIES = Path(__file__).parents[3] / "assets" / "policies"


def ball_of(env: RallyEnv, launched: float) -> BallSample:
    """Return what the robot of row 0 goes by, on a clock that stood at ``launched`` at the launch."""
    seen, eyes = env.rallies.seen[0], env.rallies.eyes
    guessed = len(eyes) > 0 and bool(is_guess(eyes[0, FILM:]))
    return BallSample(tuple(seen[:3]), tuple(seen[3:6]), int(seen[6]), launched + seen[7], guessed)


def target_of(env: RallyEnv) -> tuple[float, float]:
    return tuple(env.rallies.condition[0, [Condition.TARGET_X, Condition.TARGET_Y]])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"history": 2},
        {"spin": "hidden", "prediction": False, "age": False},
        {"ball": "filtered", "spin": "hidden", "prediction": False, "age": False},
        {"spin_expected": "strong", "history": 1, "age": False},
        {"spin_expected": "learnt"},
    ],
)
@pytest.mark.parametrize("perception", ["cheap", "full"])
@pytest.mark.parametrize("launched", [100.0, -100.0])
def test_it_sees_what_the_simulated_robot_sees(options, perception, launched):
    options = ObservationConfig(critic="policy", **options)
    config = EnvConfig(observation=options, perception=perception, foresee=0.0, go_on=0.0)
    env = RallyEnv(1, config, Deck(draw_rallies(6, seed=2)))
    observer = Observer(options)
    obs, rallies, seen_states = env.reset(), 0, set()
    observer.begin(target_of(env))
    for action in random_actions(env, 160, spread=0.1):
        now = launched + env.rallies.clock[0] * GRID_STEP
        mine = observer.observe(now, env.robot.joint_pos[0], env.robot.joint_vel[0], ball_of(env, launched))
        np.testing.assert_allclose(mine, obs[0], atol=1e-5)
        seen_states.add(int(env.rallies.seen[0, 6]))
        step = env.step(action)
        obs = step.obs
        if step.ended.size:
            rallies += 1
            observer.begin(target_of(env))

    assert rallies >= 2
    assert {0, 1} <= seen_states


@pytest.mark.parametrize("name", ["default", "paper"])
def test_a_policy_in_the_box_acts_on_it(name):
    policy = load_policy(POLICIES / name)
    observer = Observer(policy.contract.observation_options)
    observer.begin((0.7, 0.2))
    still = np.array([home for _, _, _, home in JOINT_RANGES]), np.zeros(7)
    obs = observer.observe(0.02, *still, BallSample((1.0, 0.2, 0.3), (-6.0, 0.5, 1.0), 0, 0.0))
    action = policy.act(obs[None])[0]

    assert obs.shape == (size(policy_layout(policy.contract.observation_options)),)
    assert action.shape == (7,)
    assert np.isfinite(action).all()


def test_nobody_can_be_told_the_true_spin():
    with pytest.raises(ValueError, match=r"spin 'true' can't be measured"):
        Observer(ObservationConfig(spin="true"))


def test_the_table_of_joints_is_the_robots():
    robot = RobotBatch(1)
    names, _, half_ranges, homes = zip(*JOINT_RANGES, strict=True)

    assert names == JOINTS
    np.testing.assert_allclose(half_ranges, robot.half_range)
    np.testing.assert_allclose(robot.middle, 0.0, atol=1e-12)
    np.testing.assert_allclose(homes, robot.home)
