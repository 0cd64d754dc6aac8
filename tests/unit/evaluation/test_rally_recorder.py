import numpy as np
import pytest

from common.env.rally_env import Launches, RallyEnv
from common.evaluation.rally_recorder import between_control_steps, turned
from common.physics.constants import GRID_STEP
from common.task.experience import MATCH
from common.task.states import Outcome
from tests.unit.topspin.render.recorded import NEAR_HOME, make_block, make_recorded, wave

COUNT = 24


@pytest.fixture(scope="module")
def recorded():
    return make_recorded(COUNT)


class Once:
    """A source that gives a block from its beginning at each call."""

    def __init__(self, block):
        self.block = block

    def take(self, rows):
        count = rows.size
        return Launches(self.block.launches[:count], self.block.seeds[:count], np.ones(count, np.bool_))


def test_a_recording_is_what_the_environment_played(recorded):
    task = NEAR_HOME.model_copy(update={"rounds": 2})
    env = RallyEnv(COUNT, task, Once(make_block(COUNT)), stage=3, experience=MATCH)
    obs, left = env.reset(), set(range(COUNT))
    steps = 0
    while left:
        for row in left:
            rally, k = recorded[row], 4 * steps
            np.testing.assert_array_equal(rally.ball_pos[k], env.rallies.ball[row, :3])
            np.testing.assert_array_equal(rally.ball_spin[k], env.rallies.ball[row, 6:])
            np.testing.assert_allclose(rally.joints[k], env.robot.joint_pos[row], atol=1e-12)
        step = env.step(wave(obs))
        obs, steps = step.obs, steps + 1
        over = step.finished
        for row, outcome, error in zip(over.rows, over.outcomes, over.landing_errors, strict=True):
            if row in left:
                left.remove(row)
                assert recorded[row].outcome == outcome
                np.testing.assert_equal(recorded[row].landing_error, float(error))


def test_samples_lie_on_the_grid_and_states_only_advance(recorded):
    for rally in recorded:
        np.testing.assert_allclose(rally.time, GRID_STEP * np.arange(len(rally.time)))
        assert set(np.diff(rally.state)) <= {0, 1}
        assert rally.state[0] == 0
        for values in (rally.joints, rally.ball_pos, rally.ball_vel, rally.ball_spin, rally.ball_turn):
            assert len(values) == len(rally.time)
            assert np.isfinite(values).all()


def test_the_tested_rallies_are_of_several_kinds(recorded):
    assert len({rally.outcome for rally in recorded}) >= 3
    assert max(rally.state.max() for rally in recorded) >= 2


def test_a_ball_that_landed_is_followed_further_and_its_landing_kept(recorded):
    for rally in recorded:
        landed = rally.state == 3
        assert landed.any() == (rally.outcome == Outcome.RETURNED) == bool(np.isfinite(rally.landing).all())
        if landed.any():
            assert landed.sum() > 5


def test_spin_changes_only_where_the_ball_touched_something(recorded):
    for rally in recorded:
        changes = np.flatnonzero(np.abs(np.diff(rally.ball_spin, axis=0)).max(axis=1) > 0)
        last = len(rally.time) - 2  # a rally's last touch may change the spin too
        assert set(changes) <= {*np.flatnonzero(np.diff(rally.state)), last}


def test_joints_between_control_steps_follow_any_cubic_exactly():
    c = np.random.default_rng(0).standard_normal((4, 7))
    knots, time = 0.02 * np.arange(5), np.linspace(0.0, 0.08, 33)

    def at(t):
        return sum(c[n] * t[:, None] ** n for n in range(4))

    speed = sum(n * c[n] * knots[:, None] ** (n - 1) for n in range(1, 4))

    np.testing.assert_allclose(between_control_steps(at(knots), speed, 0.02, time), at(time), atol=1e-12)


def test_a_steady_spin_turns_the_ball_by_its_rate_times_the_time():
    axis, rate = np.array([0.6, 0.0, 0.8]), 100.0

    turn = turned(np.tile(rate * axis, (9, 1)), 0.005)

    half = 0.5 * rate * 0.005 * 8
    np.testing.assert_allclose(turn[-1], [np.cos(half), *(np.sin(half) * axis)], atol=1e-12)
