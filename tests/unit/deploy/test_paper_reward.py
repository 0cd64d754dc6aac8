"""The reward of recipe `paper`, with every number written out: what the paper's matrix and e_r pay at 200 Hz.

Nothing here is imported from the reward: a change of a weight, of the reference rate or of the recipe must show.
"""

import numpy as np
import pytest

from common.env.rally_env import RallyEnv
from common.physics.chain import racket_pose
from common.rally.step import play_step
from common.robot.chain_of import chain_of
from common.task.launch import draw_rallies
from common.task.randomization import PROFILES
from common.task.states import State
from deploy.config import RECIPES, DeployConfig, settings
from tests.unit.env.rallies import Deck, hold
from tests.unit.rally.scripted import AWAY, HOME, begin, make_launch, make_motion, make_rules

CHAIN = chain_of("rails")

PERIOD = 0.005  # [s] a control step of 200 Hz, one step of the flight's grid
ORDER = ("catch_approach", "bounce", "contact", "aim", "landing", "torque", "jitter", "collision")
G = 9.81


def recipe(name="paper") -> DeployConfig:
    return settings(("--recipe", name, "--run", "r"), "p")


def play(pos, vel, stage, *, name="paper", state=State.TAU_01, pose=AWAY, moves=0.0, action=0.0, **forces):
    """Return the terms of one control step of 5 ms (20 ms for ``paper-50hz``), under the recipe's reward."""
    task = recipe(name).task
    rallies, step = begin(make_launch(pos, vel), state, target=(0.9, 0.5))
    rules = make_rules(stage, task.reward.reference_rate_hz / task.control_rate_hz, reward=task.reward)
    rules = rules._replace(grid_steps=task.grid_steps)
    after = (pose[0] + moves / task.control_rate_hz, *pose[1:])
    motion = make_motion(pose, after)._replace(step=1.0 / task.control_rate_hz / 5, **forces)
    actions = np.zeros((1, 7))
    actions[0, :2] = action
    play_step(rallies, motion, actions, rules, PROFILES["off"], step)
    return dict(zip(ORDER, step.terms[0], strict=True))


def test_the_recipe_is_played_at_200_hz_with_the_papers_numbers():
    task = recipe().task

    assert (task.control_rate_hz, task.grid_steps) == (200, 1)
    assert task.reward.model_dump() == {
        "reference_rate_hz": 200.0,
        "torque": 0.02,
        "jitter": 0.02,
        "collision": 0.1,
        "landing_scale": 1.0,
        "landing_bonus": 0.0,
        "landing_bonus_scale": 0.5,
    }


@pytest.mark.parametrize(("stage", "weight"), [(1, 1.0), (2, 0.25), (3, 0.1)])
@pytest.mark.parametrize("state", [State.TAU_01, State.TAU_12])
def test_each_step_of_the_approach_pays_the_weight_as_printed(stage, weight, state):
    ball = np.array([0.7 - PERIOD, 0.0, 0.6 - G / 2 * PERIOD**2])
    d_rb = np.linalg.norm(ball - racket_pose(CHAIN, HOME).centre)

    paid = play((0.7, 0, 0.6), (-1, 0, 0), stage, state=state, pose=HOME)

    assert paid["catch_approach"] == pytest.approx(weight / (1 + d_rb**2) ** 2)


@pytest.mark.parametrize(("stage", "weight"), [(1, 10.0), (2, 4.0), (3, 1.0)])
def test_the_bounce_pays_10_4_or_1(stage, weight):
    assert play((-0.5, 0, 0.03), (-3, 0, -4), stage)["bounce"] == weight


@pytest.mark.parametrize(
    ("stage", "speed", "paid"),
    [(1, 2.0, 25.0), (2, 2.0, 52.0), (2, 12.0, 60.0), (2, -3.0, 50.0), (3, 2.0, 10.0)],
)
def test_the_contact_pays_25_or_50_and_the_rackets_speed_up_to_10_or_10(stage, speed, paid):
    x = racket_pose(CHAIN, HOME).centre[0] + 0.06

    terms = play((x, 0, 0.226), (-16, 0, 0), stage, state=State.TAU_12, pose=HOME, moves=speed)

    assert terms["contact"] == pytest.approx(paid)


@pytest.mark.parametrize(("stage", "weight"), [(1, 0.0), (2, 0.0), (3, 1.0)])
def test_each_step_of_the_way_back_pays_the_aim_in_stage_3_alone(stage, weight):
    height = 0.8 - G / 2 * PERIOD**2 - 0.02  # above the target, the centre of a ball on the table
    d_bt = np.sqrt(0.4**2 + 0.3**2 + height**2)

    paid = play((0.5, 0.2, 0.8), (0, 0, 0), stage, state=State.TAU_23)

    assert paid["aim"] == pytest.approx(weight / (1 + d_bt**2) ** 2)


def test_the_landing_pays_30_and_40_over_the_squared_error_in_metres():
    paid = play((0.9, 0.1, 0.025), (0, 0, -4), 3, state=State.TAU_23)["landing"]

    assert paid == pytest.approx(30.0 + 40.0 / (1.0 + 0.4**2) ** 2)  # 0.4 m from the target
    assert play((0.9, 0.1, 0.025), (0, 0, -4), 2, state=State.TAU_23)["landing"] == 0.0


@pytest.mark.parametrize("stage", [1, 2, 3])
def test_each_step_costs_torque_jitter_and_collision_at_full_weight(stage):
    torque, contact = np.zeros((1, 5, 7)), np.zeros((1, 5, 4))
    torque[..., 0], torque[..., 6] = -100.0, 3.0  # a quarter of 400 N, and all of 3 Nm
    contact[..., 0], contact[..., 3] = 25.0, 400.0  # half of 50 N, and more than 50 N

    paid = play((0.7, 0, 0.6), (-1, 0, 0), stage, action=0.5, torque=torque, contact=contact)

    assert paid["torque"] == pytest.approx(-0.02 * 1.25)
    assert paid["jitter"] == pytest.approx(-0.02 * 0.5)
    assert paid["collision"] == pytest.approx(-0.1 * 1.5)


def test_at_50_hz_a_step_is_paid_as_four_steps_of_200_hz_and_jitter_as_one():
    torque = np.full((1, 5, 7), 1.0)
    slow, fast = (
        play((0.7, 0, 0.6), (0, 0, 0), 1, name=name, action=0.5, torque=torque)
        for name in ("paper-50hz", "paper")
    )

    assert slow["torque"] == pytest.approx(4.0 * fast["torque"])
    assert slow["catch_approach"] == pytest.approx(4.0 * fast["catch_approach"], rel=1e-3)
    assert slow["jitter"] == fast["jitter"]


@pytest.mark.parametrize("stage", [1, 3])
def test_an_environment_of_the_recipe_pays_the_approach_unscaled(stage):
    config = recipe()
    task = config.task.model_copy(update={"randomization": "off", "carry_over": 0.0, "reset_spread": 0.0})
    env = RallyEnv(4, task, Deck(draw_rallies(16, seed=2)), stage, experience=config.experience)
    env.reset()
    env.step(hold(env))  # the launch is a state of its own, which pays nothing

    step = env.step(hold(env))

    d_rb = np.linalg.norm(env.rallies.ball[:, :3] - step.obs[:, 14:17], axis=1)
    np.testing.assert_allclose(step.terms[:, 0], {1: 1.0, 3: 0.1}[stage] / (1 + d_rb**2) ** 2, rtol=1e-3)


def test_the_default_reward_is_not_the_papers():
    reward = settings(("--run", "r"), "p").task.reward

    assert (
        reward.reference_rate_hz == 50.0
    )  # at 200 Hz it would pay a quarter of the printed weights each step
    assert (reward.landing_scale, reward.landing_bonus) == (0.5, 100.0)
    assert sorted(path.stem for path in RECIPES.glob("*.toml")) == ["paper", "paper-50hz"]
