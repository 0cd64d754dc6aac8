"""The task's settings: which ones a match changes, the defaults, and what kernels need of them."""

import pytest
from pydantic import ValidationError

from common.errors import ConfigError
from common.physics.constants import GRID_STEP
from common.physics.flight_model import Flight
from common.task.config import PAPER_REWARD, MatchConditions, PlayConditions, RewardConfig, TaskConfig
from common.task.observation import PAPER_OBSERVATION, ObservationConfig

MATCH = MatchConditions(
    randomization="hard",
    perception="full",
    flight="simple",
    launch="match",
    rounds=5,
    collision="original",
    time_limit_s=9.0,
)


def test_a_task_under_the_conditions_of_a_match_takes_them_all_and_nothing_else():
    task = TaskConfig(
        robot="usst",
        control_rate_hz=100,
        carry_over=0.25,
        reset_spread=0.2,
        reward=PAPER_REWARD,
        observation=PAPER_OBSERVATION,
    )
    played = task.under(MATCH)

    assert {name: getattr(played, name) for name in MatchConditions.model_fields} == MATCH.model_dump()
    others = TaskConfig.model_fields.keys() - MatchConditions.model_fields.keys()
    assert others == {
        "robot",
        "rubber",
        "control_rate_hz",
        "carry_over",
        "reset_spread",
        "reward",
        "observation",
    }
    assert all(getattr(played, name) == getattr(task, name) for name in others)


def test_a_task_under_conditions_of_play_keeps_balls_and_rules():
    task = TaskConfig(launch="strong", rounds=3, collision="original", time_limit_s=4.0)
    played = task.under(PlayConditions(randomization="off", perception="full", flight="simple"))

    assert played == task.model_copy(
        update={"randomization": "off", "perception": "full", "flight": "simple"}
    )


def test_settings_of_an_evaluation_that_are_no_conditions_are_not_taken():
    class Evaluation(MatchConditions):
        rallies: int = 7

    assert TaskConfig().under(Evaluation(rounds=2)) == TaskConfig(rounds=2)


def test_the_default_task_plays_paper_balls_once_at_50_hz_with_standard_randomization():
    task = TaskConfig()

    assert (task.robot, task.rubber) == ("rails", "inverted")
    assert (task.control_rate_hz, task.launch, task.rounds) == (50, "paper", 1)
    assert (task.randomization, task.perception, task.flight, task.collision) == (
        "standard",
        "cheap",
        "full",
        "tailored",
    )
    assert (task.time_limit_s, task.carry_over, task.reset_spread) == (2.5, 0.5, 0.1)
    assert (task.reward, task.observation) == (RewardConfig(), ObservationConfig())


@pytest.mark.parametrize(("name", "model"), [("simple", Flight.SIMPLE), ("full", Flight.FULL)])
def test_the_flight_model_is_the_one_that_the_setting_names(name, model):
    assert TaskConfig(flight=name).flight_model is model


@pytest.mark.parametrize(("rate", "steps"), [(25, 8), (50, 4), (100, 2), (200, 1)])
def test_a_control_step_is_a_whole_number_of_grid_steps_at_every_rate(rate, steps):
    task = TaskConfig(control_rate_hz=rate)

    assert task.grid_steps == steps
    assert task.grid_steps * GRID_STEP * rate == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("rate", [30, 60, 400])
def test_a_rate_whose_control_step_is_not_on_the_grid_is_refused(rate):
    with pytest.raises(ValidationError, match="25, 50, 100 or 200"):
        TaskConfig(control_rate_hz=rate)


@pytest.mark.parametrize(
    "setting", [{"randomisation": "off"}, {"perception": "camera"}, {"launch": "papre"}], ids=str
)
def test_an_unknown_setting_or_value_is_refused(setting):
    with pytest.raises(ValidationError, match=next(iter(setting))):
        TaskConfig.model_validate(setting)


def test_conditions_that_make_no_task_are_refused():
    task = TaskConfig(rubber="anti_spin")

    assert task.under(MatchConditions(launch="strong")).launch == "strong"
    with pytest.raises(ConfigError, match="rubber anti_spin with collision original"):
        task.under(MatchConditions(collision="original"))
