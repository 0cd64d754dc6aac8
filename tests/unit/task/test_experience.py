"""How training plays the task, and that a match plays every rally to its end."""

import numpy as np
import pytest
from pydantic import ValidationError

from common.env.rally_env import RallyEnv
from common.task.config import TaskConfig
from common.task.experience import MATCH, ExperienceConfig, TeacherConfig
from common.task.launch import draw_rallies
from common.task.states import State
from tests.unit.env.rallies import Deck, random_actions


def test_a_match_has_no_second_rally_no_early_end_no_way_home_and_no_teacher():
    assert (MATCH.continue_share, MATCH.end_at_hit_share, MATCH.leads_home) == (0.0, 0.0, False)
    assert not MATCH.teacher.policy


def test_a_match_plays_every_rally_to_its_end():
    env = RallyEnv(64, TaskConfig(), Deck(draw_rallies(512, seed=1)), stage=3, experience=MATCH)
    env.reset()
    flights_after_the_hit = 0
    for action in random_actions(env, 120):
        assert not env.rallies.ends_at_hit.any()
        assert (env.rallies.rounds_left == 1).all()
        step = env.step(action)

        np.testing.assert_array_equal(step.ended, step.finished.rows)
        flights_after_the_hit += (env.rallies.state == State.TAU_23).sum()

    assert flights_after_the_hit > 10


def test_training_ends_and_continues_the_shares_of_episodes_that_it_is_set_to():
    experience = ExperienceConfig(continue_share=0.3, end_at_hit_share=0.6)
    env = RallyEnv(2000, TaskConfig(), Deck(draw_rallies(2000, seed=1)), experience=experience)
    env.reset()
    continues = env.rallies.rounds_left == 2

    # three standard errors of a share of 2,000 are 0.033
    assert continues.mean() == pytest.approx(0.3, abs=0.033)
    # an episode that continues after a return does not end at its first hit
    assert env.rallies.ends_at_hit.mean() == pytest.approx(0.7 * 0.6, abs=0.033)
    assert not (continues & env.rallies.ends_at_hit).any()


def test_the_defaults_end_four_of_five_episodes_at_the_hit_and_lead_home():
    experience = ExperienceConfig()

    assert (experience.continue_share, experience.end_at_hit_share) == (0.4, 0.8)
    assert experience.leads_home
    assert experience.teacher == TeacherConfig()


def test_a_teacher_teaches_only_the_first_epochs():
    teacher = TeacherConfig(policy="p", epochs=3)

    assert [teacher.teaches(version) for version in range(5)] == [True, True, True, False, False]


def test_without_a_policy_there_is_no_teacher():
    assert not TeacherConfig().teaches(0)


@pytest.mark.parametrize("setting", [{"end_at_hit_share": 1.1}, {"end_at_hit": 0.8}], ids=str)
def test_an_unknown_setting_or_value_is_refused(setting):
    with pytest.raises(ValidationError, match=next(iter(setting))):
        ExperienceConfig.model_validate(setting)
