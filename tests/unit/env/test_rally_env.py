"""The environment: batch equals loop, rallies as generated, ends and resets told apart, faults contained."""

import numpy as np
import pytest

from common.env.rally_env import EnvConfig, EnvStep, Launches, RallyEnv
from common.physics.constants import GRID_STEP
from common.physics.flight import SIMPLE
from common.physics.fly import NO_ROBOT, fly_step, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import ROBOT_COURT
from common.rally.launch import draw_rallies
from common.rally.noise import PROFILES, Condition
from common.rally.observation import OBSERVATION, ObservationConfig, critic_layout, offsets, size
from common.rally.play import MAX_SPEED_REWARDED
from common.rally.trajectory import Outcome, State
from tests.unit.env.rallies import QUIET, Deck, make_env, random_actions
from tests.unit.physics.contacts import as_vec

AT = offsets(OBSERVATION)
STANDARD = EnvConfig(noise="standard")


class Replay:
    """Deals one environment's rallies in the order a batch dealt them to it."""

    def __init__(self, launches: list[Launches]) -> None:
        self.launches = list(launches)

    def take(self, count: int) -> Launches:
        assert count == 1
        return self.launches.pop(0)


class Dealt(Deck):
    """Remembers who got which rally."""

    def __init__(self, *args, **options) -> None:
        super().__init__(*args, **options)
        self.log: list[Launches] = []

    def take(self, count: int) -> Launches:
        self.log.append(super().take(count))
        return self.log[-1]


def only(launches: Launches, row: int) -> Launches:
    rows = slice(row, row + 1)
    return Launches(launches.records[rows], launches.seeds[rows], launches.validated[rows])


def hold(env: RallyEnv) -> np.ndarray:
    return np.tile(env.home_action, (env.count, 1))


def play_until_end(env: RallyEnv, row: int = 0, steps: int = 200) -> EnvStep:
    for _ in range(steps):
        step = env.step(hold(env))
        if row in step.finished.rows:
            return step
    raise AssertionError("no rally ended")


def drop_on(env: RallyEnv, x: float, row: int = 0) -> None:
    """Let the ball of a row, hit by the robot, fall onto the table at ``x``."""
    env.rallies.ball[row] = [x, 0.1, 0.1, 0, 0, 0, 0, 0, 0]
    env.rallies.state[row] = State.TAU_23
    env.rallies.caught[row] = True


@pytest.mark.parametrize(
    "config",
    [
        STANDARD,
        STANDARD.model_copy(update={"go_on": 1.0}),
        STANDARD.model_copy(update={"perception": "full", "go_on": 1.0}),
    ],
    ids=["ends", "goes on", "camera"],
)
def test_a_batch_equals_its_environments_one_by_one_bit_for_bit(config):
    deck = Dealt(draw_rallies(200, seed=3))
    batch = RallyEnv(8, config, deck)
    actions = random_actions(batch, 120)
    first = batch.reset()
    steps = [batch.step(action) for action in actions]
    dealt = [[only(deck.log[0], row)] for row in range(8)]
    for launches, rows in zip(
        deck.log[1:], [s.finished.rows for s in steps if s.finished.rows.size], strict=True
    ):
        for k, row in enumerate(rows):
            dealt[row].append(only(launches, k))

    assert sum(len(rallies) for rallies in dealt) > 24
    for row in range(8):
        env = RallyEnv(1, config, Replay(dealt[row]))
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
    one, two = (make_env(8, STANDARD, rallies=100) for _ in range(2))
    actions = random_actions(one, 60)

    assert one.reset().tobytes() == two.reset().tobytes()
    for action in actions:
        assert one.step(action).obs.tobytes() == two.step(action).obs.tobytes()


def test_a_second_reset_begins_as_the_first():
    env = RallyEnv(4, STANDARD, Deck(draw_rallies(4, seed=1)))
    first = env.reset()
    env._source.next = 0  # the same rallies again

    assert env.reset().tobytes() == first.tobytes()


def test_a_rally_flies_as_it_was_generated_and_bounces_where_it_was_validated():
    """Bit for bit through the bounce: the robot stands at home, behind the first bounce of all of these."""
    block = draw_rallies(20, seed=5)
    env = RallyEnv(20, STANDARD, Deck(block))
    env.reset()
    conditions = env.rallies.condition.copy()
    path = [env.rallies.ball.copy()]
    while env.rallies.clock.min() < 160:
        step = env.step(hold(env))
        path.append(env.rallies.ball.copy())
        if step.finished.rows.size:
            break
    bounced = 0
    for row, (launch, condition) in enumerate(zip(block.launches, conditions, strict=True)):
        pos, vel, spin = as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9])
        air = (launch[9], launch[10], SIMPLE)
        touched, before, flown, what, normal = fly_to_touch(pos, vel, spin, 2.0, *air, NO_ROBOT)
        after, turned = table_bounce(
            before, spin, normal, condition[Condition.TABLE_RESTITUTION0], condition[Condition.TABLE_FRICTION]
        )
        assert what == ROBOT_COURT
        for k, balls in enumerate(path[:-1]):
            moment = 4 * k * GRID_STEP
            if moment < flown:
                p, v, _, _, _ = fly_to_touch(pos, vel, spin, moment, *air, NO_ROBOT)

                assert balls[row].tobytes() == np.array([*p, *v, *spin]).tobytes()
                last = k
        if last + 1 < len(path) - 1:
            p, v = touched, after
            grid_steps = int(flown / GRID_STEP + 1e-9)
            rest = (grid_steps + 1) * GRID_STEP - flown
            for h in [rest] + [GRID_STEP] * (4 * (last + 1) - grid_steps - 1):
                p, v, _, _, _ = fly_step(p, v, turned, h, *air, NO_ROBOT, 0.0, 1.0, 0.0)

            # the sum of flown times rounds, so the rest of the step after the bounce may differ in its last bit
            np.testing.assert_allclose(path[last + 1][row], [*p, *v, *turned], rtol=1e-12, atol=1e-12)
            bounced += 1
    assert bounced >= 5


def test_the_time_limit_truncates_and_the_last_observation_is_the_balls():
    env = make_env(1, QUIET.model_copy(update={"time_limit_s": 0.2}))
    env.reset()
    for _ in range(9):
        assert env.step(hold(env)).ended.size == 0
    launch = env._source.block.launches[0]
    p, v, _, _, _ = fly_to_touch(
        as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9]), 0.2, 1, 1, SIMPLE, NO_ROBOT
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
        np.hypot(0.7 - env_target(step)[0], 0.1 - env_target(step)[1]), rel=1e-5
    )


def env_target(step: EnvStep) -> np.ndarray:
    return step.finished.conditions[0, [Condition.TARGET_X, Condition.TARGET_Y]]


@pytest.mark.parametrize("option", [{"rounds": 2}, {"go_on": 1.0}], ids=str)
def test_over_a_return_the_next_rally_is_launched_with_the_robot_as_it_stands(option):
    env = make_env(1, QUIET.model_copy(update=option))
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
    # the robot went on from where it was, and isn't home
    np.testing.assert_allclose(env.robot.joint_pos, before, atol=0.1)
    assert np.abs(env.robot.joint_pos[0] - env.robot.home).max() > 0.1
    np.testing.assert_array_equal(step.obs[0, AT["ball_pos"]], np.float32(env._source.block.launches[1, :3]))


def test_the_last_round_of_an_episode_terminates():
    env = make_env(1, QUIET.model_copy(update={"rounds": 2}))
    env.reset()
    ends = []
    for _ in range(2):
        drop_on(env, 0.7)
        ends.append(bool(play_until_end(env).terminated[0]))

    assert ends == [False, True]


def test_rallies_are_numbered_within_their_episode():
    env = make_env(1, QUIET.model_copy(update={"rounds": 3}))
    env.reset()
    numbers = []
    for is_returned in (True, True, True, True, False, False):
        if is_returned:
            drop_on(env, 0.7)
        numbers.append(int(play_until_end(env).finished.rounds[0]))

    assert numbers == [1, 2, 3, 1, 2, 1]


def test_a_rally_that_is_lost_ends_an_episode_of_many_rounds():
    env = make_env(1, QUIET.model_copy(update={"rounds": 10}))
    env.reset()

    assert play_until_end(env).terminated[0]


def test_rewards_of_a_rally_add_up_to_its_return():
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


def test_a_steps_facts_are_not_overwritten_by_the_next_step():
    env = make_env(4, STANDARD)
    env.reset()
    actions = random_actions(env, 2)
    step = env.step(actions[0])
    kept = (step.obs.copy(), step.reward.copy(), step.terms.copy(), step.terminated.copy())
    env.step(actions[1])

    for was, now in zip(kept, (step.obs, step.reward, step.terms, step.terminated), strict=True):
        np.testing.assert_array_equal(was, now)


@pytest.mark.parametrize("validated", [True, False])
def test_whether_a_rally_was_validated_is_told_with_its_end(validated):
    env = RallyEnv(2, QUIET, Deck(draw_rallies(8, seed=1), validated=validated))
    env.reset()

    np.testing.assert_array_equal(env.validated, [validated] * 2)
    np.testing.assert_array_equal(play_until_end(env).finished.validated, validated)


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


def test_actions_that_are_not_numbers_are_refused():
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


def test_the_stage_chooses_the_rewards_column():
    bounces = []
    for stage in (1, 2, 3):
        env = make_env(1, stage=stage)
        env.reset()
        bounces.append(max(env.step(hold(env)).terms[0, 1] for _ in range(60)))

    assert bounces == [10.0, 4.0, 1.0]


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0.0, 0.0), (0.5, 0.35, 0.65), (1.0, 1.0, 1.0)])
def test_that_share_of_episodes_begins_as_the_last_stroke_left_the_robot(share, low, high):
    env = make_env(32, QUIET.model_copy(update={"carry_over": share}), rallies=400)
    env.reset()
    aside = hold(env)
    aside[:, 1] = 0.5  # far from home at the end of every rally
    stayed = []
    for _ in range(160):
        step = env.step(aside)
        stayed.extend(np.abs(env.robot.joint_pos[step.ended, 1]) > 0.1)

    # some 100 resets: 0.35 to 0.65 are three standard errors
    assert len(stayed) >= 90
    assert low <= np.mean(stayed) <= high


def test_robots_that_go_home_start_within_the_spread():
    env = make_env(64, QUIET.model_copy(update={"reset_spread": 0.1}), rallies=64)
    env.reset()
    offset = env.robot.joint_pos - env.robot.home

    assert np.abs(offset).max() <= 0.1
    assert np.abs(offset).max() > 0.09


@pytest.mark.parametrize("spin", ["estimated", "true"])
def test_every_number_stays_within_its_stated_range_in_random_play(spin):
    seen = ObservationConfig(history=2, spin=spin)
    layout = critic_layout(seen)
    at = offsets(layout)
    env = make_env(64, EnvConfig(noise="hard", observation=seen), rallies=2000)
    env.reset()
    rng = np.random.default_rng(0)
    low, high = np.full(size(layout), np.inf), np.full(size(layout), -np.inf)
    for _ in range(150):
        obs = env.step(rng.uniform(-1, 1, (64, 7))).obs
        low, high = np.minimum(low, obs.min(axis=0)), np.maximum(high, obs.max(axis=0))

    for part in layout:
        assert low[at[part.name]].min() >= part.low, part.name
        assert high[at[part.name]].max() <= part.high, part.name


def test_a_fault_of_the_simulation_sends_that_robot_home_and_leaves_its_rally_out_of_the_rates(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log file of its warnings
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


def test_the_balls_impulse_reaches_the_racket_in_the_next_step_and_only_then():
    env = make_env(1)
    env.reset()
    racket = env.robot.model.body("racket").id
    wrench = env.robot.batch.bind("xfrc_applied")[0, racket]
    env.rallies.ball[0] = [-1.0, 0, 0.226, -6, 0, 0, 0, 0, 0]
    env.rallies.state[0] = State.TAU_12
    env.step(hold(env))
    force = wrench.copy()
    env.step(hold(env))

    # m (1 + e) |u_n| = 2.7e-3 (1 + .878 - .020 x 6) 6 = 0.0285 N s in 20 ms; nearly upright face
    assert force[0] == pytest.approx(-0.0285 / 0.020, rel=0.03)
    np.testing.assert_array_equal(wrench, 0.0)


@pytest.mark.parametrize("rate", [50, 100, 200])
def test_a_ball_flies_alike_at_every_control_rate(rate):
    """One integration grid: what the robot doesn't touch doesn't depend on how often it decides."""
    env = make_env(4, QUIET.model_copy(update={"control_rate_hz": rate}))
    env.reset()
    for _ in range(rate // 10):
        env.step(hold(env))
    launch = env._source.block.launches[0]
    p, _, _, _, _ = fly_to_touch(
        as_vec(launch[:3]), as_vec(launch[3:6]), as_vec(launch[6:9]), 0.1, 1, 1, SIMPLE, NO_ROBOT
    )

    np.testing.assert_array_equal(env.rallies.ball[0, :3], p)


def test_a_stroke_through_the_ball_is_caught_with_the_rackets_speed():
    """A robot driven at the ball by its own drives: contact, state and stage 2's pay from one rally."""
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


def test_every_profile_can_be_played():
    for noise in PROFILES:
        env = make_env(2, EnvConfig(noise=noise))
        env.reset()

        assert np.isfinite(env.step(hold(env)).reward).all()
