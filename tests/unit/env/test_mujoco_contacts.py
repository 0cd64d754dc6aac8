"""MuJoCo's own contacts: nothing passes through, bounces are as documented, rules and reward are the same."""

import numpy as np
import pytest

from common.env.mujoco_ball import HARD, RUBBER, STEP
from common.env.rally_env import EnvStep, RallyEnv
from common.physics.chain import racket_pose
from common.physics.constants import BALL_INERTIA, BALL_MASS, BALL_RADIUS
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.robot.chain_of import chain_of
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
from common.task.states import Outcome, State
from tests.unit.env.rallies import PLAYED_OUT, QUIET, Deck, hold, make_env, random_actions
from tests.unit.physics.contacts import as_vec

CHAIN = chain_of("rails")

ORIGINAL = QUIET.model_copy(update={"collision": "original"})
HOME = (0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0)
RACKET_X = racket_pose(CHAIN, HOME).centre[0]


def put(env: RallyEnv, ball: tuple[float, ...], state: State = State.TAU_12, row: int = 0) -> None:
    """Put a ball in play: position, velocity, spin."""
    env.rallies.ball[row] = ball
    env.rallies.state[row] = state
    env._contacts.launch(env.rallies, np.array([row]))


def with_ball(ball: tuple[float, ...], state: State = State.TAU_12, **options) -> RallyEnv:
    env = make_env(1, ORIGINAL.model_copy(update=options))
    env.reset()
    put(env, ball, state)
    return env


def play(env: RallyEnv, steps: int = 100) -> EnvStep:
    """Hold the robot at home until the rally ends."""
    for _ in range(steps):
        step = env.step(hold(env))
        if step.finished.rows.size:
            break
    return step


@pytest.mark.parametrize("speed", [5.0, 10.0, 20.0])
@pytest.mark.parametrize("aside", [0.0, 0.05])
def test_no_ball_passes_through_a_racket_that_moves_towards_it(speed, aside):
    env = make_env(1, ORIGINAL)
    env.reset()
    push = env.home_action[None].copy()
    push[0, 0] = 1.0
    for _ in range(4):  # to about 2 m/s
        x, y, z = as_vec(env.step(push).obs[0, 14:17])
    put(env, (x + 0.15, y + aside, z, -speed, 0, 0, 0, 0, 0))
    for _ in range(3):
        env.step(push)

    assert env.rallies.caught[0]
    assert env.rallies.ball[0, 0] > env.robot.joint_pos[0, 0] + RACKET_X
    assert env.rallies.ball[0, 3] > 0.0


@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_no_ball_passes_through_the_table(speed):
    env = with_ball((-0.7, 0.5, 0.2, 0, 0, -speed, 0, 0, 0), State.TAU_01)
    env.step(hold(env))
    env.step(hold(env))

    assert env.rallies.state[0] == State.TAU_12
    assert env.rallies.ball[0, 2] > 0.0
    assert env.rallies.ball[0, 5] > 0.0


def test_the_springs_stop_a_ball_before_its_centre_reaches_the_middle_of_the_racket():
    """A ball presses an undamped spring in by v / sqrt(stiffness): 15 mm of 26.5 mm at 30 m/s."""
    assert 30.0 / np.sqrt(RUBBER.stiffness) < 0.0065 + BALL_RADIUS
    assert 20.0 / np.sqrt(HARD.stiffness) < 1.01 * BALL_RADIUS
    assert STEP <= 0.0005


@pytest.mark.parametrize("speed", [2.0, 5.0, 8.0])
def test_the_table_returns_92_percent_of_the_normal_speed(speed):
    """As our table's law does at 3 m/s: 0.98 - 0.02 * 3. MuJoCo's restitution does not fall with the speed."""
    env = with_ball((-0.7, 0.5, 0.02 + 0.004 * speed, 0, 0, -speed, 0, 0, 0), State.TAU_01)
    env.step(hold(env))
    drag = 1.0 - 0.28 * 0.55 * speed * 0.020  # over the step, bounce included
    # gravity after the bounce cancels gravity before it, except for the difference of the two times
    assert env.rallies.ball[0, 5] == pytest.approx(0.92 * speed * drag, abs=0.2)


def test_the_racket_returns_79_percent_of_the_normal_speed():
    """As inverted rubber's law does at 4.35 m/s: 0.878 - 0.020 * 4.35, on average over the time in a step.

    Drag takes 1 % of the speed on the way. A ball that begins its contact at another time in a step may leave with
    0.70 or with 0.85 of its speed.
    """
    speed, returned = 4.35, []
    for late in np.linspace(0.0, 1.0, 20, endpoint=False):
        away = 0.0265 + (0.01 + late * STEP) * speed
        env = with_ball((RACKET_X + away, 0, 0.226, -speed, 0, 0, 0, 0, 0))
        env.step(hold(env))
        returned.append(env.rallies.ball[0, 3] / speed)

    assert np.mean(returned) == pytest.approx(0.78, abs=0.02)
    assert np.std(returned) < 0.08


def test_topspin_speeds_the_ball_up_at_the_bounce_and_backspin_slows_it():
    def forward_speed(spin: float) -> float:
        env = with_ball((-0.5, 0.5, 0.06, -3, 0, -3, 0, spin, 0), State.TAU_01)
        env.step(hold(env))
        return float(-env.rallies.ball[0, 3])

    assert forward_speed(-300.0) > forward_speed(0.0) + 0.1
    assert forward_speed(0.0) > forward_speed(300.0) + 0.1


def test_no_bounce_on_the_table_adds_energy():
    rng = np.random.default_rng(0)
    env = make_env(64, ORIGINAL)
    env.reset()
    velocity = rng.uniform([-6, -4, -6], [6, 4, -1], (64, 3))
    spin = rng.uniform(-200, 200, (64, 3))
    energy = []
    for row in range(64):
        # 5 ms of flight above the table, so that every bounce ends within 20 ms
        height = BALL_RADIUS - 0.005 * velocity[row, 2]
        put(env, (-0.7, 0.3, height, *velocity[row], *spin[row]), State.TAU_01, row)
    env.rallies.parameters[:, :2] = 0.0  # no air
    env._contacts.launch(env.rallies, np.arange(64))
    for _ in range(2):
        v, w, z = env.rallies.ball[:, 3:6], env.rallies.ball[:, 6:], env.rallies.ball[:, 2]
        kinetic = 0.5 * BALL_MASS * (v**2).sum(axis=1) + 0.5 * BALL_INERTIA * (w**2).sum(axis=1)
        energy.append(kinetic + BALL_MASS * 9.81 * z)
        env.step(hold(env))

    assert np.all(env.rallies.ball[:, 5] > 0.0)
    assert np.all(energy[1] < 1.001 * energy[0])


def test_the_flight_agrees_with_the_tailored_flight_within_2_mm():
    """The air's force is held for 5 ms, gravity is integrated semi-implicitly: g h t / 2 = 1 mm at 0.4 s."""
    block = draw_rallies(16, seed=4)
    env = RallyEnv(16, ORIGINAL, Deck(block), experience=PLAYED_OUT)
    env.reset()
    flown = 0.0
    for _ in range(12):
        env.step(hold(env))
        flown += 0.02
        for row, launch in enumerate(block.launches):
            pos, vel, spin = as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9])
            p, _, t, what, _ = fly_to_touch(pos, vel, spin, flown, Air(launch[9], launch[10], FULL), NO_ROBOT)
            if not what and env.rallies.state[row] == State.TAU_01:
                assert t == pytest.approx(flown)
                np.testing.assert_allclose(env.rallies.ball[row, :3], p, atol=0.002)
                np.testing.assert_allclose(env.rallies.ball[row, 6:], spin, atol=1e-6)


@pytest.mark.parametrize(
    ("outcome", "ball", "state"),
    [
        (Outcome.RETURNED, (0.7, 0.1, 0.1, 0, 0, 0, 0, 0, 0), State.TAU_23),
        (Outcome.OWN_COURT, (-0.7, 0.5, 0.1, 0, 0, 0, 0, 0, 0), State.TAU_23),
        (Outcome.NET, (0.3, 0.1, 0.08, -6, 0, 0.3, 0, 0, 0), State.TAU_23),
        (Outcome.EDGE, (1.385, 0.1, 0.1, 0, 0, 0, 0, 0, 0), State.TAU_23),
        (Outcome.OUT, (1.2, 0.1, 0.3, 12, 0, 3, 0, 0, 0), State.TAU_23),
        (Outcome.DOUBLE_HIT, (RACKET_X + 0.1, 0, 0.226, -4, 0, 0, 0, 0, 0), State.TAU_23),
        (Outcome.BODY, (-1.40, 0.8, 0.4, -0.5, 0, -1.5, 0, 0, 0), State.TAU_12),
        (Outcome.VOLLEY, (RACKET_X + 0.1, 0, 0.226, -4, 0, 0, 0, 0, 0), State.TAU_01),
        (Outcome.DOUBLE_BOUNCE, (-0.5, 0.5, 0.1, -0.1, 0, 0, 0, 0, 0), State.TAU_01),
        (Outcome.MISS, (-1.2, 0.5, 0.4, -8, 0, 0, 0, 0, 0), State.TAU_12),
        (Outcome.BAD_LAUNCH, (0.7, 0.1, 0.1, -0.1, 0, 0, 0, 0, 0), State.TAU_01),
    ],
    ids=lambda value: value.name if isinstance(value, Outcome) else "",
)
def test_touches_have_the_outcomes_of_the_same_table(outcome, ball, state):
    assert play(with_ball(ball, state)).finished.outcomes[0] == outcome


def test_a_contact_of_several_substeps_is_one_touch():
    env = with_ball((RACKET_X + 0.1, 0, 0.226, -4, 0, 0, 0, 0, 0))
    env.step(hold(env))
    step = env.step(hold(env))

    assert step.finished.rows.size == 0
    assert env.rallies.state[0] == State.TAU_23


def test_a_legal_hit_is_paid_as_with_tailored_contacts():
    env = with_ball((RACKET_X + 0.08, 0, 0.226, -6, 0, 0, 0, 0, 0))
    env.set_stage(2)
    step = env.step(hold(env))

    assert env.rallies.caught[0]
    assert step.terms[0, 2] == pytest.approx(50.0, abs=0.1)


def test_the_balls_force_on_the_racket_is_no_collision():
    env = with_ball((RACKET_X + 0.08, 0, 0.226, -6, 0, 0, 0, 0, 0))

    assert env.step(hold(env)).terms[0, 7] == 0.0


def test_the_ball_pushes_the_racket_back():
    def racket_speed(distance: float) -> float:
        env = with_ball((RACKET_X + distance, 0, 0.226, -10, 0, 0, 0, 0, 0))
        return float(env.step(hold(env)).obs[0, 21])

    assert racket_speed(0.15) < racket_speed(0.9) - 0.02


def test_validated_rallies_bounce_on_the_robots_court():
    env = RallyEnv(
        64, ORIGINAL, Deck(draw_rallies(64, TaskConfig(randomization="off"), seed=2)), experience=PLAYED_OUT
    )
    env.reset()
    bounced = np.zeros(64, bool)
    for _ in range(40):
        step = env.step(hold(env))
        bounced |= env.rallies.state >= State.TAU_1
        bounced |= step.terms[:, 1] > 0.0

    # a ball that clears net or line by very little may touch it in the other integration
    assert bounced.mean() > 0.95


def test_a_batch_equals_its_environments_one_by_one():
    block = draw_rallies(4, seed=7)
    task = ORIGINAL.model_copy(update={"randomization": "standard"})
    batch = RallyEnv(4, task, Deck(block), experience=PLAYED_OUT)
    batch.reset()
    actions = random_actions(batch, 12)
    observed = np.array([batch.step(action).obs for action in actions])
    for row in range(4):
        env = RallyEnv(1, task, Deck(block, first=row), experience=PLAYED_OUT)
        env.reset()
        for k, action in enumerate(actions):
            assert env.step(action[row : row + 1]).obs[0].tobytes() == observed[k, row].tobytes()


def test_a_failure_of_the_simulation_affects_only_its_own_environment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file of its warnings
    env = make_env(2, ORIGINAL)
    env.reset()
    env.robot.joint_vel[0, 3] = np.nan
    steps = [env.step(hold(env)) for _ in range(2)]

    assert all(np.isfinite(step.obs).all() and np.isfinite(step.reward).all() for step in steps)
    # the robot is home and the ball out of play: the rally ends and all rates leave it out
    np.testing.assert_array_equal(steps[1].ended, [0])
    np.testing.assert_array_equal(steps[1].finished.validated, [False])


@pytest.mark.parametrize("rate", [100, 200])
def test_the_outcome_is_the_same_at_every_control_rate(rate):
    env = with_ball((-0.7, 0.5, 0.1, 0, 0, 0, 0, 0, 0), State.TAU_23, control_rate_hz=rate)

    assert play(env).finished.outcomes[0] == Outcome.OWN_COURT
