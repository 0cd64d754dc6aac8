"""A teacher observes the rallies that its student plays, with its own observation options."""

import numpy as np
import pytest

from common.env.rally_env import RallyEnv
from common.env.teacher import teacher_of
from common.policy.contract import PolicyError
from common.policy.folder import load_policy
from common.task.config import TaskConfig
from common.task.experience import TeacherConfig
from common.task.launch import draw_rallies
from common.task.observation import PAPER_OBSERVATION, ObservationConfig, policy_layout, size
from tests.unit.env.rallies import Deck, random_actions
from tests.unit.env.teachers import write_teacher

MORE = ObservationConfig(critic="policy")
PAPER = TaskConfig(observation=PAPER_OBSERVATION)


def make_env(count: int = 6, task: TaskConfig = PAPER, **options) -> RallyEnv:
    return RallyEnv(count, task, Deck(draw_rallies(64, seed=5)), **options)


@pytest.mark.parametrize("extra", [MORE, PAPER_OBSERVATION, ObservationConfig(ball="filtered", spin="true")])
@pytest.mark.parametrize("own", [PAPER_OBSERVATION, ObservationConfig(ball="filtered", spin="hidden")])
def test_the_extra_observation_is_the_one_of_an_environment_with_these_options(extra, own):
    env = make_env(task=TaskConfig(observation=own), extra_observation=extra)
    same = make_env(task=TaskConfig(observation=extra))
    env.reset()
    expected = same.reset()
    width = size(policy_layout(extra))
    for action in random_actions(env, 80):
        np.testing.assert_array_equal(env.observe_extra(), expected[:, :width])
        env.step(action)
        expected = same.step(action).obs


def test_the_extra_observation_does_not_change_the_rallies():
    observed, alone = make_env(extra_observation=MORE), make_env()
    np.testing.assert_array_equal(observed.reset(), alone.reset())
    for action in random_actions(alone, 60):
        observed.observe_extra()
        one, other = observed.step(action), alone.step(action)
        np.testing.assert_array_equal(one.obs, other.obs)
        np.testing.assert_array_equal(one.reward, other.reward)


def test_an_extra_observation_without_its_options_is_refused():
    env = make_env(2)
    env.reset()

    with pytest.raises(RuntimeError, match="without extra_observation"):
        env.observe_extra()


def test_advice_is_the_action_of_the_teachers_policy(tmp_path):
    teacher = teacher_of(PAPER, write_teacher(tmp_path / "t", observation=MORE))
    env = make_env(extra_observation=teacher.observation)
    env.reset()
    advice = teacher.advice(env)

    assert teacher.observation == MORE
    assert advice.shape == (6, 7)
    np.testing.assert_array_equal(advice, load_policy(tmp_path / "t").act(env.observe_extra()).clip(-1, 1))


def test_target_shrink_moves_the_teachers_targets_towards_the_courts_middle(tmp_path):
    config = write_teacher(tmp_path / "t", observation=MORE).model_copy(update={"target_shrink": 0.25})
    teacher = teacher_of(PAPER, config)
    env = make_env(extra_observation=teacher.observation)
    env.reset()
    moved = env.observe_extra()
    moved[:, 30] = 0.75 * moved[:, 30] + 0.25 * 0.685
    moved[:, 31] *= 0.75

    np.testing.assert_allclose(
        teacher.advice(env), load_policy(tmp_path / "t").act(moved).clip(-1, 1), atol=1e-6
    )


def test_without_a_policy_there_is_no_teacher():
    assert teacher_of(PAPER, TeacherConfig()) is None


@pytest.mark.parametrize(
    ("theirs", "message"),
    [
        ({"control_rate_hz": 100}, "control_rate_hz is 100; allowed: the task's, 50"),
        ({"robot": "usst"}, "robot is usst; allowed: the task's, rails"),
        ({"observation": ObservationConfig(history=2)}, "observation.history is 2; allowed: the task's, 0"),
    ],
)
def test_a_policy_that_cannot_play_the_task_is_refused_as_its_teacher(tmp_path, theirs, message):
    config = write_teacher(tmp_path / "t", **theirs)

    with pytest.raises(PolicyError, match=message):
        teacher_of(PAPER, config)


def test_a_teacher_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(PolicyError, match=r"no policy .*missing"):
        teacher_of(PAPER, TeacherConfig(policy=str(tmp_path / "missing")))
