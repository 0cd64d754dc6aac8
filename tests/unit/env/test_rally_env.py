"""The environment: a batch equals its rallies, balls fly as generated, bad actions are refused, failures stay local."""

import numpy as np
import pytest

from common.env.rally_env import Launches, RallyEnv
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL, Air
from common.physics.fly import NO_ROBOT, fly_step, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import ROBOT_COURT
from common.rally.step import MAX_SPEED_REWARDED
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import draw_rallies
from common.task.observation import OBSERVATION, ObservationConfig, critic_layout, offsets, size
from common.task.randomization import PROFILES, RallyParameter
from common.task.states import State
from tests.unit.env.rallies import QUIET, Deck, hold, make_env, random_actions
from tests.unit.physics.contacts import as_vec

AT = offsets(OBSERVATION)
CONTINUES = ExperienceConfig(continue_share=1.0)


class Replay:
    """Gives the rallies of one environment in the order in which a batch got them."""

    def __init__(self, launches: list[Launches]) -> None:
        self.launches = list(launches)

    def take(self, rows) -> Launches:
        assert rows.size == 1
        return self.launches.pop(0)


class LoggedDeck(Deck):
    """Logs the rallies that it gives."""

    def __init__(self, *args, **options) -> None:
        super().__init__(*args, **options)
        self.log: list[Launches] = []

    def take(self, rows) -> Launches:
        self.log.append(super().take(rows))
        return self.log[-1]


def only(launches: Launches, row: int) -> Launches:
    rows = slice(row, row + 1)
    return Launches(launches.launches[rows], launches.seeds[rows], launches.validated[rows])


@pytest.mark.parametrize(
    ("task", "experience"),
    [
        (TaskConfig(), ExperienceConfig()),
        (TaskConfig(), CONTINUES),
        (TaskConfig(perception="full"), CONTINUES),
    ],
    ids=["ends", "continues", "camera"],
)
def test_a_batch_equals_its_environments_one_by_one_bit_for_bit(task, experience):
    deck = LoggedDeck(draw_rallies(200, seed=3))
    batch = RallyEnv(8, task, deck, experience=experience)
    actions = random_actions(batch, 120)
    first = batch.reset()
    steps = [batch.step(action) for action in actions]
    given = [[only(deck.log[0], row)] for row in range(8)]
    for launches, rows in zip(
        deck.log[1:], [s.finished.rows for s in steps if s.finished.rows.size], strict=True
    ):
        for k, row in enumerate(rows):
            given[row].append(only(launches, k))

    assert sum(len(rallies) for rallies in given) > 24
    for row in range(8):
        env = RallyEnv(1, task, Replay(given[row]), experience=experience)
        assert env.reset()[0].tobytes() == first[row].tobytes()
        for action, expected in zip(actions, steps, strict=True):
            step = env.step(action[row : row + 1])

            assert step.obs[0].tobytes() == expected.obs[row].tobytes()
            assert step.reward[0] == expected.reward[row]
            assert step.terms[0].tobytes() == expected.terms[row].tobytes()
            assert (step.terminated[0], step.truncated[0]) == (
                expected.terminated[row],
                expected.truncated[row],
            )
            if step.ended.size:
                assert step.final_obs.tobytes() == expected.final_obs[expected.ended == row].tobytes()


def test_the_same_rallies_and_actions_give_the_same_bits():
    one, two = (make_env(8, TaskConfig(), ExperienceConfig(), rallies=100) for _ in range(2))
    actions = random_actions(one, 60)

    assert one.reset().tobytes() == two.reset().tobytes()
    for action in actions:
        assert one.step(action).obs.tobytes() == two.step(action).obs.tobytes()


def test_a_second_reset_begins_as_the_first():
    env = RallyEnv(4, TaskConfig(), Deck(draw_rallies(4, seed=1)))
    first = env.reset()
    env._source.next = 0  # the same rallies again

    assert env.reset().tobytes() == first.tobytes()


def test_a_rally_flies_as_it_was_generated_and_bounces_where_it_was_validated():
    """Bit for bit through the bounce: the robot is at home, and all these balls bounce in front of it."""
    block = draw_rallies(20, seed=5)
    env = RallyEnv(20, TaskConfig(), Deck(block))
    env.reset()
    drawn = env.rallies.parameters.copy()
    path = [env.rallies.ball.copy()]
    while env.rallies.clock.min() < 160:
        step = env.step(hold(env))
        path.append(env.rallies.ball.copy())
        if step.finished.rows.size:
            break
    bounced = 0
    for row, (launch, parameters) in enumerate(zip(block.launches, drawn, strict=True)):
        pos, vel, spin = as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9])
        air = Air(launch[9], launch[10], FULL)
        touched, before, flown, what, normal = fly_to_touch(pos, vel, spin, 2.0, air, NO_ROBOT)
        after, turned = table_bounce(
            before,
            spin,
            normal,
            parameters[RallyParameter.TABLE_RESTITUTION0],
            parameters[RallyParameter.TABLE_FRICTION],
        )
        assert what == ROBOT_COURT
        for k, balls in enumerate(path[:-1]):
            moment = 4 * k * GRID_STEP
            if moment < flown:
                p, v, _, _, _ = fly_to_touch(pos, vel, spin, moment, air, NO_ROBOT)

                assert balls[row].tobytes() == np.array([*p, *v, *spin]).tobytes()
                last = k
        if last + 1 < len(path) - 1:
            p, v = touched, after
            grid_steps = int(flown / GRID_STEP + 1e-9)
            rest = (grid_steps + 1) * GRID_STEP - flown
            for h in [rest] + [GRID_STEP] * (4 * (last + 1) - grid_steps - 1):
                p, v, _, _, _ = fly_step(p, v, turned, h, air, NO_ROBOT, 0.0)

            # sums of times are rounded, so the rest of the step after the bounce may differ in its last bit
            np.testing.assert_allclose(path[last + 1][row], [*p, *v, *turned], rtol=1e-12, atol=1e-12)
            bounced += 1
    assert bounced >= 5


@pytest.mark.parametrize("rate", [50, 100, 200])
def test_a_ball_flies_the_same_at_every_control_rate(rate):
    """There is one integration grid: without a touch by the robot, the flight does not depend on the control rate."""
    env = make_env(4, QUIET.model_copy(update={"control_rate_hz": rate}))
    env.reset()
    for _ in range(rate // 10):
        env.step(hold(env))
    launch = env._source.block.launches[0]
    p, _, _, _, _ = fly_to_touch(
        as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9]), 0.1, Air(1, 1, FULL), NO_ROBOT
    )

    np.testing.assert_array_equal(env.rallies.ball[0, :3], p)


def test_the_arrays_of_a_step_are_not_overwritten_by_the_next_step():
    env = make_env(4, TaskConfig(), ExperienceConfig())
    env.reset()
    actions = random_actions(env, 2)
    step = env.step(actions[0])
    kept = (step.obs.copy(), step.reward.copy(), step.terms.copy(), step.terminated.copy())
    env.step(actions[1])

    for was, now in zip(kept, (step.obs, step.reward, step.terms, step.terminated), strict=True):
        np.testing.assert_array_equal(was, now)


def test_actions_are_clipped_to_their_range():
    inside, beyond = make_env(2), make_env(2)
    inside.reset()
    beyond.reset()
    sign = np.sign(np.random.default_rng(0).standard_normal((2, 7)))

    np.testing.assert_array_equal(inside.step(sign).obs, beyond.step(5.0 * sign).obs)


def test_actions_of_a_wrong_shape_are_refused():
    env = make_env(2)
    env.reset()

    with pytest.raises(ValueError, match=r"actions of shape \(7,\): allowed is \(2, 7\)"):
        env.step(env.home_action)


def test_actions_that_are_not_finite_are_refused():
    env = make_env(3)
    env.reset()
    actions = hold(env)
    actions[1, 4] = np.nan

    with pytest.raises(ValueError, match=r"actions of rows \[1\] aren't finite"):
        env.step(actions)


def test_a_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match=r"step\(\) before reset\(\): call reset\(\) first"):
        make_env(1).step(np.zeros((1, 7)))


@pytest.mark.parametrize("stage", [0, 4, "1"])
def test_an_unknown_stage_is_refused(stage):
    with pytest.raises(ValueError, match="allowed are 1, 2, 3"):
        make_env(1, stage=stage)


def test_the_stage_selects_the_column_of_the_reward():
    bounces = []
    for stage in (1, 2, 3):
        env = make_env(1, stage=stage)
        env.reset()
        bounces.append(max(env.step(hold(env)).terms[0, 1] for _ in range(60)))

    assert bounces == [10.0, 4.0, 1.0]


@pytest.mark.parametrize("spin", ["estimated", "true"])
def test_in_random_play_every_number_is_within_its_documented_range(spin):
    observation = ObservationConfig(history=2, spin=spin)
    layout = critic_layout(observation)
    at = offsets(layout)
    env = make_env(
        64, TaskConfig(randomization="hard", observation=observation), ExperienceConfig(), rallies=2000
    )
    env.reset()
    rng = np.random.default_rng(0)
    low, high = np.full(size(layout), np.inf), np.full(size(layout), -np.inf)
    for _ in range(150):
        obs = env.step(rng.uniform(-1, 1, (64, 7))).obs
        low, high = np.minimum(low, obs.min(axis=0)), np.maximum(high, obs.max(axis=0))

    for part in layout:
        assert low[at[part.name]].min() >= part.low, part.name
        assert high[at[part.name]].max() <= part.high, part.name


def test_a_failure_of_a_simulation_sends_its_robot_home_and_leaves_its_rally_out_of_the_rates(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log file of its warnings
    env, healthy = make_env(3), make_env(3)
    env.reset()
    healthy.reset()
    env.robot.joint_vel[1] = np.nan
    step, expected = env.step(hold(env)), healthy.step(hold(env))

    assert np.isfinite(step.obs).all()
    assert np.isfinite(step.reward).all()
    np.testing.assert_array_equal(env.robot.joint_pos[1], env.robot.home)
    np.testing.assert_array_equal(env.validated, [True, False, True])
    np.testing.assert_array_equal(step.obs[[0, 2]], expected.obs[[0, 2]])


def test_the_balls_impulse_acts_on_the_racket_only_in_the_next_step():
    env = make_env(1)
    env.reset()
    racket = env.robot.model.body("racket").id
    wrench = env.robot.batch.bind("xfrc_applied")[0, racket]
    env.rallies.ball[0] = [-1.0, 0, 0.226, -6, 0, 0, 0, 0, 0]
    env.rallies.state[0] = State.TAU_12
    env.step(hold(env))
    force = wrench.copy()
    env.step(hold(env))

    # m (1 + e) |u_n| = 2.7e-3 (1 + 0.878 - 0.020 x 6) 6 = 0.0285 N s in 20 ms; the face is nearly vertical
    assert force[0] == pytest.approx(-0.0285 / 0.020, rel=0.03)
    np.testing.assert_array_equal(wrench, 0.0)


def test_a_stroke_catches_the_ball_and_is_paid_for_the_rackets_speed():
    """The drives move the racket into the ball: contact, state and the reward of stage 2 in one rally."""
    env = make_env(1, QUIET, stage=2)
    env.reset()
    push = hold(env)
    push[0, 0] = 1.0
    for _ in range(4):
        env.step(push)
    speed = float(env.robot.joint_vel[0, 0])
    x, y, z = as_vec(env.step(push).obs[0, AT["racket_pos"]])
    env.rallies.ball[0] = [x + 0.1, y, z, -4, 0, 0, 0, 0, 0]
    env.rallies.state[0] = State.TAU_12
    step = env.step(push)

    assert env.rallies.caught[0]
    assert 50.0 + speed < step.terms[0, 2] < 50.0 + MAX_SPEED_REWARDED


def test_every_randomization_can_be_played():
    for profile in PROFILES:
        env = make_env(2, TaskConfig(randomization=profile), ExperienceConfig())
        env.reset()

        assert np.isfinite(env.step(hold(env)).reward).all()
