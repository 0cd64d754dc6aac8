"""A teacher is shown the very rallies that its pupil plays, by its own observation."""

import numpy as np
import pytest

from common.env.rally_env import EnvConfig, RallyEnv, TeacherConfig
from common.env.teacher import teacher_of
from common.policy.weights import PolicyError, load_policy
from common.rally.launch import draw_rallies
from common.rally.observation import PAPER_OBSERVATION, ObservationConfig, offsets, policy_layout, size
from tests.unit.env.rallies import Deck, random_actions
from tests.unit.env.teachers import write_teacher

MORE = ObservationConfig(critic="policy")
PAPER = EnvConfig(observation=PAPER_OBSERVATION)


@pytest.mark.parametrize("sees", [MORE, PAPER_OBSERVATION, ObservationConfig(ball="filtered", spin="true")])
@pytest.mark.parametrize("shown", [PAPER_OBSERVATION, ObservationConfig(ball="filtered", spin="hidden")])
def test_an_onlooker_sees_what_it_would_see_playing(sees, shown):
    def environment(config, **options):
        return RallyEnv(6, EnvConfig(observation=config), Deck(draw_rallies(64, seed=5)), **options)

    env, own = environment(shown, onlooker=sees), environment(sees)
    env.reset()
    seen = own.reset()
    width = size(policy_layout(sees))
    for action in random_actions(env, 80):
        np.testing.assert_array_equal(env.look_on(), seen[:, :width])
        env.step(action)
        seen = own.step(action).obs


def test_looking_on_changes_nothing():
    def environment(**options):
        return RallyEnv(6, PAPER, Deck(draw_rallies(64, seed=5)), **options)

    watched, alone = environment(onlooker=MORE), environment()
    np.testing.assert_array_equal(watched.reset(), alone.reset())
    for action in random_actions(alone, 60):
        watched.look_on()
        one, other = watched.step(action), alone.step(action)
        np.testing.assert_array_equal(one.obs, other.obs)
        np.testing.assert_array_equal(one.reward, other.reward)


def test_nobody_looks_on_unless_asked_to():
    env = RallyEnv(2, PAPER, Deck(draw_rallies(8, seed=5)))
    env.reset()

    with pytest.raises(RuntimeError, match="without an onlooker"):
        env.look_on()


def test_advice_is_what_the_policy_in_the_folder_would_have_done(tmp_path):
    config = PAPER.model_copy(update={"teacher": write_teacher(tmp_path / "t", observation=MORE)})
    teacher = teacher_of(config)
    env = RallyEnv(6, config, Deck(draw_rallies(64, seed=5)), onlooker=teacher.sees)
    advice = teacher.advice(env, env.reset())

    assert teacher.sees == MORE
    assert advice.shape == (6, 7)
    np.testing.assert_array_equal(advice, load_policy(tmp_path / "t").act(env.look_on()).clip(-1, 1))


def test_the_teacher_of_a_pupil_that_should_play_safe_is_shown_targets_farther_inside(tmp_path):
    given = write_teacher(tmp_path / "t", observation=MORE).model_copy(update={"towards_middle": 0.25})
    teacher = teacher_of(PAPER.model_copy(update={"teacher": given}))
    env = RallyEnv(6, PAPER, Deck(draw_rallies(64, seed=5)), onlooker=teacher.sees)
    seen = env.reset()
    shown = env.look_on()
    shown[:, 30] = 0.75 * shown[:, 30] + 0.25 * 0.685
    shown[:, 31] *= 0.75

    np.testing.assert_allclose(
        teacher.advice(env, seen), load_policy(tmp_path / "t").act(shown).clip(-1, 1), atol=1e-6
    )


def test_notes_hold_what_the_pupil_saw_first_until_the_stroke(tmp_path):
    given = write_teacher(tmp_path / "t", observation=MORE)
    plain, noting = (
        teacher_of(PAPER.model_copy(update={"teacher": given.model_copy(update={"notes": notes})}))
        for notes in (False, True)
    )
    env = RallyEnv(6, PAPER, Deck(draw_rallies(64, seed=5)), onlooker=noting.sees)
    obs, meeting_in = env.reset(), offsets(policy_layout(MORE))["meeting_in"].start
    age, first = np.zeros(6), obs[:, [28, 26]]
    held = said = rallies = 0
    for action in random_actions(env, 150):
        first[age < 3] = obs[age < 3][:, [28, 26]]  # y of its velocity, its height; 0, 20 and 40 ms on
        free = (env.look_on()[:, meeting_in] > 0.24) & (obs[:, 33] == 1.0)
        wanted = plain.advice(env, obs)
        wanted[free, 6] = np.clip(0.22 * first[free, 0], -0.95, 0.95)
        wanted[free, 5] = np.clip(1.1 / 2.1 + 0.8 * (first[free, 1] - 0.48), -0.95, 0.95)

        np.testing.assert_allclose(noting.advice(env, obs), wanted, atol=1e-6)
        held, said = held + free.sum(), said + (~free).sum()
        step = env.step(action)
        obs, ended = step.obs, step.terminated | step.truncated
        age, rallies = np.where(ended, 0, age + 1), rallies + ended.sum()

    assert min(held, said) > 100
    assert rallies > 6


def test_who_does_not_know_when_a_ball_will_be_met_cannot_say_until_when_to_hold_notes(tmp_path):
    given = write_teacher(tmp_path / "t", observation=PAPER_OBSERVATION).model_copy(update={"notes": True})

    with pytest.raises(PolicyError, match=r"observation.prediction is False; allowed with teacher.notes"):
        teacher_of(PAPER.model_copy(update={"teacher": given}))


def test_a_task_without_a_teacher_has_none():
    assert teacher_of(PAPER) is None
    assert not PAPER.teacher.teaches(0)


def test_a_teacher_teaches_the_first_epochs():
    assert [TeacherConfig(policy="p", epochs=3).teaches(version) for version in range(5)] == [True] * 3 + [
        False
    ] * 2


@pytest.mark.parametrize(
    ("theirs", "said"),
    [
        ({"control_rate_hz": 100}, "control_rate_hz is 100.0; allowed is the task's, 50"),
        ({"robot": "usst"}, "robot is usst; allowed is the task's, rails"),
        (
            {"observation": ObservationConfig(history=2)},
            "observation.history is 2; allowed is the task's, 0",
        ),
    ],
)
def test_who_could_not_play_the_task_cannot_teach_it(tmp_path, theirs, said):
    config = PAPER.model_copy(update={"teacher": write_teacher(tmp_path / "t", **theirs)})

    with pytest.raises(PolicyError, match=said):
        teacher_of(config)


def test_a_teacher_that_is_not_there_is_named(tmp_path):
    config = PAPER.model_copy(update={"teacher": TeacherConfig(policy=str(tmp_path / "nobody"))})

    with pytest.raises(PolicyError, match=r"no policy in .*nobody"):
        teacher_of(config)
