"""Robot and ball in MuJoCo: contact parameters as documented, and long steps only where nothing is in reach."""

import numpy as np
import pytest

from common.env import mujoco_ball
from common.env.mujoco_ball import STEP, load_model, obstacles
from common.env.rally_env import RallyEnv
from common.physics.chain import racket_pose
from common.physics.constants import BALL_INERTIA, BALL_MASS, BALL_RADIUS
from common.robot.chain_of import chain_of
from common.task.launch import draw_rallies
from common.task.states import State
from tests.unit.env.rallies import PLAYED_OUT, QUIET, Deck, make_env, random_actions

CHAIN = chain_of("rails")

ORIGINAL = QUIET.model_copy(update={"collision": "original"})


def test_the_ball_in_the_model_has_the_balls_mass_inertia_and_radius():
    model = load_model("rails")
    ball = model.body("ball")

    assert ball.mass == pytest.approx(BALL_MASS)
    np.testing.assert_allclose(ball.inertia, BALL_INERTIA)
    assert model.geom("ball").size[0] == BALL_RADIUS


@pytest.mark.parametrize(("geom", "surface"), [(geom, surface) for geom, _, surface in obstacles("rails")])
def test_contact_parameters_are_as_documented(geom, surface):
    pair = load_model("rails").pair(f"ball on {geom}")

    np.testing.assert_array_equal(pair.solref, [-surface.stiffness, -surface.damping])
    np.testing.assert_array_equal(pair.friction[:2], surface.friction)


def test_without_an_obstacle_in_reach_one_long_step_is_as_good_as_ten_short_steps(monkeypatch):
    """The same rallies once more with only short steps. Robots move, and their drives are late.

    Measured: before the bounce balls differ by 1.2 mm at most and joints by 1 mm and 7 to 13 mrad (medians). After the
    bounce balls differ by 13 mm (median): MuJoCo's bounces depend on the time in a step at which they begin
    (restitution 0.88 to 1.2 for spinning balls).
    """
    block = draw_rallies(64, seed=6)

    def play_all() -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        env = RallyEnv(64, ORIGINAL, Deck(block), experience=PLAYED_OUT)
        env.reset()
        gains = np.ones((64, 3, 7))
        env.robot.set_gains(np.arange(64), gains, np.linspace(0.0, 0.010, 64))
        places, states, joints, near = [], [], [], []
        is_first = np.ones(64, np.bool_)
        for action in random_actions(env, 20, spread=0.1):
            is_first[env.step(action).ended] = False
            places.append(np.where(is_first[:, None], env.rallies.ball[:, :3], np.nan))
            states.append(np.where(is_first, env.rallies.state, -1))
            joints.append(np.where(is_first[:, None], env.robot.joint_pos, np.nan))
            near.append(env.robot._is_near.mean())
        return np.array(places), np.array(states), np.array(joints), float(np.mean(near))

    places, states, joints, near = play_all()
    monkeypatch.setattr(mujoco_ball, "_within_reach", lambda chain, qpos, qvel, path, out: out.fill(True))
    fine_places, fine_states, fine_joints, everything = play_all()
    off = np.linalg.norm(places - fine_places, axis=2)
    before_bounce, after_bounce = (
        (states == state) & (fine_states == state) for state in (State.TAU_01, State.TAU_12)
    )

    assert near < 0.15 < everything == 1.0
    assert before_bounce.sum() > 500 < 3 * after_bounce.sum()
    assert off[before_bounce].max() < 0.002
    assert np.median(off[after_bounce]) < 0.03
    assert (states != fine_states).mean() < 0.01
    assert (np.nanmedian(np.abs(joints - fine_joints), axis=(0, 1)) < 0.02).all()


def test_a_ball_with_an_obstacle_within_reach_is_never_missed():
    """Random places and velocities: every ball that touches an obstacle within 5 ms is near."""
    rng = np.random.default_rng(0)
    env = make_env(512, ORIGINAL, rallies=512)
    env.reset()
    touches = 0
    # between upper arm and forearm: nearer to one, and flying towards the other
    bent = make_env(1, ORIGINAL)
    bent.reset()
    bent.robot.joint_pos[0] = (0, 0, 0, 0, np.pi / 2, 0, 0)
    elbow_x, elbow_z = -1.45, 0.33 + 0.22
    aside, below = 0.035 + BALL_RADIUS + 0.027, 0.030 + BALL_RADIUS + 0.029
    bent.robot.qpos[0, 7:10] = (elbow_x + aside, 0.0, elbow_z - below)
    bent.robot.qvel[0, 7:13] = (0.0, 0.0, 8.0, 0.0, 0.0, 0.0)
    mujoco_ball._within_reach(CHAIN, bent.robot.qpos, bent.robot.qvel, bent.robot._path, bent.robot._is_near)
    assert bent.robot._is_near[0]
    for _ in range(6):
        env.step(env.home_action + 0.5 * rng.standard_normal((512, 7)))
        pose = np.array([racket_pose(CHAIN, tuple(q)).centre for q in env.robot.joint_pos])
        spots = np.where(
            rng.random((512, 1)) < 0.5, pose, rng.uniform([-1.5, -0.8, 0], [1.4, 0.8, 0.2], (512, 3))
        )
        env.robot.qpos[:, 7:10] = spots + 0.07 * rng.standard_normal((512, 3))
        env.robot.qvel[:, 7:10] = 6.0 * rng.standard_normal((512, 3))
        mujoco_ball._within_reach(CHAIN, env.robot.qpos, env.robot.qvel, env.robot._path, env.robot._is_near)
        is_near = env.robot._is_near.copy()
        records = env.robot._roll_out(np.arange(512), STEP, np.tile(env.robot.home, (512, 10, 1)))
        touched = (records["sensordata"][:, :, 32:] > 0.0).any(axis=(1, 2))
        touches += (touched & is_near).sum()
        assert not (touched & ~is_near).any()
        env.reset()
    assert touches > 300
