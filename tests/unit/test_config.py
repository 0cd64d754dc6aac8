import tomllib
from typing import Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from common.config import ConfigError, HelpRequest, load, record, to_table


class Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PPO(Frozen):
    clip: float = Field(0.2, gt=0, le=1, description="ratio beyond which nothing is gained")
    rates: tuple[float, ...] = (5e-4,)


class Shared(Frozen):
    run: str = Field("default", description="name of the run")


class Learner(Shared):
    """Settings of a learner."""

    max_lag: int = Field(2, ge=0, description="versions behind", json_schema_extra={"unit": "versions"})
    learning_rate: float = Field(5e-4, gt=0)
    mode: Literal["hub", "client"] = "hub"
    stage: Literal[1, 2, 3] = 1
    resume: bool = False
    limit: float | None = None
    ppo: PPO = PPO(clip=0.3)


def load_learner(*argv: str, file: str = "", **environ: str) -> Learner:
    flags = [*argv, "--config", file] if file else argv
    return load(Learner, flags, prog="learner", section="learner", environ=environ)


@pytest.fixture
def toml(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "topspin.toml"
        path.write_text(text)
        return str(path)

    return write


def test_without_anything_the_defaults_hold():
    assert load_learner() == Learner()


def test_flags_beat_the_environment_which_beats_the_file(toml):
    file = toml("[learner]\nmax_lag = 5\nlearning_rate = 0.1\nmode = 'client'\n")

    settings = load_learner(
        "--max-lag", "7", file=file, TOPSPIN_LEARNER__MAX_LAG="6", TOPSPIN_LEARNER__LEARNING_RATE="0.2"
    )

    assert (settings.max_lag, settings.learning_rate, settings.mode) == (7, 0.2, "client")


def test_a_setting_of_a_model_within_leaves_its_neighbours_as_the_outer_model_has_them(toml):
    assert load_learner("--ppo.rates", "0.1, 0.2").ppo == PPO(clip=0.3, rates=(0.1, 0.2))
    assert load_learner(TOPSPIN_LEARNER__PPO__CLIP="0.4").ppo == PPO(clip=0.4)
    assert load_learner(file=toml("[learner.ppo]\nrates = [1.0]")).ppo == PPO(clip=0.3, rates=(1.0,))


@pytest.mark.parametrize(
    ("argv", "field", "value"),
    [
        (["--max_lag", "1"], "max_lag", 1),
        (["--max-lag=1"], "max_lag", 1),
        (["--resume"], "resume", True),
        (["--resume", "--max-lag", "1"], "resume", True),
        (["--resume", "false"], "resume", False),
        (["--stage", "3"], "stage", 3),
        (["--limit", "none"], "limit", None),
        (["--limit", "2.5"], "limit", 2.5),
    ],
)
def test_flags_come_in_the_usual_forms(argv, field, value):
    assert getattr(load_learner(*argv), field) == value


def test_what_all_services_share_is_set_once(toml):
    assert load_learner(TOPSPIN_RUN="night").run == "night"
    assert load_learner(file=toml("run = 'night'\n[actor]\nx = 1")).run == "night"
    assert load_learner(TOPSPIN_RUN="night", TOPSPIN_LEARNER__RUN="day").run == "day"


def test_what_is_meant_for_other_services_is_passed_over(toml):
    assert load_learner(file=toml("[actor]\nenvs = 3"), TOPSPIN_ACTOR__ENVS="3", HOME="/") == Learner()


def test_the_file_may_be_named_by_the_environment(toml):
    assert load_learner(TOPSPIN_CONFIG=toml("[learner]\nmax_lag = 1")).max_lag == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[learner]\nlerning_rate = 1",
            "unknown key learner.'lerning_rate' in .*; did you mean 'learning_rate'",
        ),
        ("[learner.ppo]\nclap = 1", "unknown key learner.ppo.'clap' in .*; did you mean 'clip'?"),
        ("[learner.pppo]\nclip = 1", "unknown key learner.'pppo' in .*; did you mean 'ppo'?"),
        ("[lerner]\nmax_lag = 1", "unknown key 'lerner' in .*; did you mean 'learner'?"),
        ("rum = 'x'", "unknown key 'rum' in .*; did you mean 'run'?"),
        ("max_lag = 1", "unknown key 'max_lag' in .*; allowed: "),
        ("learner = 3", r"learner in .* is 3; allowed: a table \[learner\]"),
        ("[learner]\nppo = 3", "unknown key learner.'ppo'"),
        (
            "[learner]\nmax_lag = 'few'",
            r"learner.max_lag = 'few' \(.*toml\); allowed: a whole number, from 0",
        ),
        ("[learner", "is not TOML"),
    ],
)
def test_a_bad_file_is_one_clear_line(toml, text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        load_learner(file=toml(text))

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--lerning-rate", "1"], "unknown flag --lerning-rate; did you mean '--learning-rate'?"),
        (["--max-lag"], "--max-lag needs a value"),
        (["--max-lag", "--resume"], "--max-lag needs a value"),
        (["night"], "unexpected argument 'night'; settings are given as --name value"),
        (["--max-lag", "-1"], r"learner.max_lag = '-1' \(--max-lag\); allowed: a whole number, from 0"),
        (["--ppo.clip", "2"], r"learner.ppo.clip = '2' \(--ppo.clip\); allowed: a number, above 0 to 1"),
        (["--mode", "both"], r"learner.mode = 'both' \(--mode\); allowed: hub, client"),
        (["--limit", "much"], r"learner.limit = 'much' \(--limit\); allowed: a number or none"),
        (["--ppo.rates", "0.1,x"], "learner.ppo.rates = 'x' .*; allowed: list of a number"),
        (["--max-lag", "x", "--mode", "y"], r"learner.max_lag = 'x' .* \(and 1 more\)"),
        (["--config", "/nowhere.toml"], "can't read /nowhere.toml: No such file"),
    ],
)
def test_a_bad_flag_is_one_clear_line(argv, message):
    with pytest.raises(ConfigError, match=message):
        load_learner(*argv)


def test_a_bad_variable_is_named():
    with pytest.raises(ConfigError, match=r"TOPSPIN_LEARNER__MAX_LOG; did you mean '.*MAX_LAG'"):
        load_learner(TOPSPIN_LEARNER__MAX_LOG="1")
    with pytest.raises(ConfigError, match=r"learner.max_lag = 'x' \(TOPSPIN_LEARNER__MAX_LAG\)"):
        load_learner(TOPSPIN_LEARNER__MAX_LAG="x")


def test_help_shows_unit_range_and_default_of_every_setting():
    with pytest.raises(HelpRequest) as caught:
        load_learner("--help")

    text = str(caught.value)
    assert "--max-lag        versions behind [versions] (a whole number, from 0; default 2)" in text
    assert "ratio beyond which nothing is gained (a number, above 0 to 1; default 0.3)" in text
    assert "hub, client; default hub" in text
    assert "TOPSPIN_RUN" in text


def test_a_written_file_is_read_back_as_it_was(tmp_path):
    settings = Learner(max_lag=1, resume=True, ppo=PPO(rates=(0.1, 0.2)))
    record(tmp_path / "settings.toml", {"learner": to_table(settings)})

    assert load_learner(file=str(tmp_path / "settings.toml")) == settings


def test_recording_one_services_settings_leaves_the_others_as_they_were(tmp_path):
    file = tmp_path / "settings.toml"
    record(file, {"learner": {"max_lag": 1, "limit": 2.0}, "actor": {"envs": 3}})
    record(file, {"learner": {"max_lag": 4}})

    assert tomllib.loads(file.read_text()) == {"learner": {"max_lag": 4}, "actor": {"envs": 3}}
    assert list(tmp_path.iterdir()) == [file]


def test_what_a_run_has_recorded_gives_way_to_flags_and_variables_and_a_file_that_is_named(toml, tmp_path):
    recorded = tmp_path / "recorded.toml"
    record(recorded, {"learner": {"max_lag": 3, "stage": 3}})
    named = toml("[learner]\nmax_lag = 4")

    def found(*argv, **environ):
        settings = load(Learner, argv, prog="p", section="learner", environ=environ, recorded=recorded)
        return settings.max_lag, settings.stage

    assert found() == found(TOPSPIN_CONFIG=named) == (3, 3)
    assert found("--max-lag", "5") == found(TOPSPIN_LEARNER__MAX_LAG="5") == (5, 3)
    assert found("--config", named) == (4, 1)
