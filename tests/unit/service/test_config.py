import tomllib
from pathlib import Path
from typing import ClassVar, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from common.errors import ConfigError, HelpRequest
from common.service.config import load, save_settings, to_tables
from common.service.config_sources import SHARED, TABLES, named_file


class Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PPO(Frozen):
    clip: float = Field(0.2, gt=0, le=1, description="largest probability ratio")
    rates: tuple[float, ...] = (5e-4,)


class Shared(Frozen):
    run: str = Field("default", description="name of the run")


class Task(Frozen):
    launch: Literal["paper", "strong"] = Field("paper", description="which balls")
    robot: str = "rails"


class LearnerOptions(Frozen):
    max_lag: int = 2
    ppo: PPO = PPO(clip=0.3)


class Learner(Shared):
    """Settings of a learner."""

    often: ClassVar = {"The run": ("run",), "Learning": ("max_lag", "ppo.clip")}

    max_lag: int = Field(2, ge=0, description="versions behind", json_schema_extra={"unit": "versions"})
    learning_rate: float = Field(5e-4, gt=0)
    mode: Literal["hub", "client"] = "hub"
    stage: Literal[1, 2, 3] = 1
    resume: bool = False
    limit: float | None = None
    ppo: PPO = PPO(clip=0.3)
    task: Task = Task()


class Whole(Shared):
    """Settings of a program that starts a learner."""

    actors: int = Field(1, ge=1)
    panel: bool = False
    task: Task = Task()
    learner: LearnerOptions = LearnerOptions()


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


@pytest.mark.parametrize(
    ("text", "number"), [("60e6", 60_000_000), ("1.5E3", 1500), ("7", 7), ("1_000", 1000)]
)
def test_a_whole_number_may_have_an_exponent(text, number):
    assert load_learner("--max-lag", text).max_lag == number


@pytest.mark.parametrize("text", ["1e-3", "1.5e0", "1e", "1e999999999"])
def test_a_number_with_an_exponent_that_is_not_whole_is_refused(text):
    with pytest.raises(
        ConfigError, match=rf"learner.max_lag = '{text}' \(--max-lag\); allowed: a whole number"
    ):
        load_learner("--max-lag", text)


def test_without_settings_the_defaults_hold():
    assert load_learner() == Learner()


def test_flags_beat_the_environment_which_beats_the_file(toml):
    file = toml("[learner]\nmax_lag = 5\nlearning_rate = 0.1\nmode = 'client'\n")

    settings = load_learner(
        "--max-lag", "7", file=file, TOPSPIN_LEARNER__MAX_LAG="6", TOPSPIN_LEARNER__LEARNING_RATE="0.2"
    )

    assert (settings.max_lag, settings.learning_rate, settings.mode) == (7, 0.2, "client")


def test_a_nested_setting_leaves_its_siblings_at_the_outer_models_defaults(toml):
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


def test_shared_settings_are_set_once(toml):
    assert load_learner(TOPSPIN_RUN="night").run == "night"
    assert load_learner(file=toml("run = 'night'\n[actor]\nx = 1")).run == "night"
    assert load_learner(TOPSPIN_RUN="night", TOPSPIN_LEARNER__RUN="day").run == "day"


def test_settings_of_other_services_are_ignored(toml):
    file = toml("[learner]\n[actor]\nenvs = 3")

    assert load_learner(file=file, TOPSPIN_ACTOR__ENVS="3", HOME="/") == Learner()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[learner]\nmax_lag = 1\n[play]\nvideo = 'x'",
            r"\[play\] in .* is not used: learner reads \[task\], ",
        ),
        ("[actor]\nenvs = 3", r"nothing in .* is used: learner reads \[task\], \[learner\]; got actor"),
        ("actors = 3", "nothing in .* is used: .*; got actors"),
    ],
)
def test_a_given_file_that_is_not_for_this_program_is_an_error(toml, text, message):
    file = toml(text)
    with pytest.raises(ConfigError, match=message):
        load_learner(file=file)

    assert load_learner(TOPSPIN_CONFIG=file)  # one that all programs of a person share


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
        ("max_lag = 1", r"max_lag in .* stands in no table; allowed: under \[learner\]"),
        ("clip = 0.1", r"clip in .* stands in no table; allowed: under \[learner.ppo\]"),
        ("[ppo]\nclip = 0.1", r"unknown table \[ppo\] in .*; did you mean \[learner.ppo\]"),
        ("[learner]\nclip = 0.1", "unknown key learner.'clip' in .*; did you mean 'learner.ppo.clip'"),
        ("[task]\nlunch = 'paper'", "unknown key task.'lunch' in .*; did you mean 'launch'?"),
        (
            "[learner.task]\nlaunch = 'paper'",
            r"unknown key learner.task.launch in .*; allowed: a table \[task\] of its own",
        ),
        ("task = 3", r"task in .* is 3; allowed: a table \[task\]"),
        ("[task]\nlaunch = 'odd'", r"task.launch = 'odd' \(.*toml\); allowed: paper, strong"),
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


def help_of(*argv):
    with pytest.raises(HelpRequest) as caught:
        load_learner(*argv)
    return str(caught.value)


def test_the_short_help_has_the_settings_that_people_change():
    text = help_of("--help")

    assert "--max-lag" in text
    assert "--ppo.clip" in text
    assert "--stage" not in text
    assert "all 11 settings" in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_long_help_has_unit_range_and_default_of_every_setting():
    text = " ".join(help_of("--help-all").split())

    assert "--max-lag versions behind [versions] (a whole number, from 0; default 2)" in text
    assert "largest probability ratio (a number, above 0 to 1; default 0.3)" in text
    assert "hub, client; default hub" in text
    assert "--task.launch which balls (paper, strong; default paper)" in text
    assert "TOPSPIN_LEARNER__PPO__CLIP" in text


def test_help_is_grouped_by_purpose_and_the_long_one_by_table():
    short, whole = help_of("--help").splitlines(), help_of("--help-all").splitlines()

    assert short.index("The run:") < short.index("Learning:") < short.index("Also:")
    assert whole.index("Settings:") < whole.index("[ppo]:") < whole.index("Also:")


def test_what_differs_from_the_defaults_is_printed_as_a_file_that_says_the_same(toml):
    given = ("--run", "night", "--ppo.clip", "0.1", "--task.launch", "strong", "--max-lag", "2")

    text = help_of(*given, "--print-config")

    assert tomllib.loads(text) == {
        "run": "night",
        "task": {"launch": "strong"},
        "learner": {"ppo": {"clip": 0.1}},
    }
    assert load_learner(file=toml(text)) == load_learner(*given)
    assert help_of("--print-config") == "# learner: every setting has its default\n"


def test_the_task_is_set_once_for_every_program(toml):
    file = toml("run = 'night'\n[task]\nlaunch = 'strong'\n[learner]\nmax_lag = 5\n[local]\npanel = true\n")

    learner = load_learner(file=file)

    assert (learner.run, learner.task.launch, learner.max_lag) == ("night", "strong", 5)
    assert load_learner("--task.launch", "strong").task == Task(launch="strong")
    assert load_learner(TOPSPIN_TASK__LAUNCH="strong").task == Task(launch="strong")


def load_whole(*argv, **environ):
    return load(Whole, argv, prog="whole", section="local", environ=environ)


def test_a_program_that_starts_others_reads_their_tables_too(toml):
    file = toml(
        "[task]\nlaunch = 'strong'\n[learner]\nmax_lag = 5\n[local]\npanel = true\n[actor]\nenvs = 3\n"
    )

    whole = load_whole("--config", file, "--learner.ppo.clip", "0.1", TOPSPIN_ACTORS="3")

    assert (whole.task.launch, whole.learner.max_lag, whole.panel) == ("strong", 5, True)
    assert (whole.learner.ppo.clip, whole.actors) == (0.1, 3)
    assert load_whole(TOPSPIN_LEARNER__MAX_LAG="7").learner.max_lag == 7


def test_a_written_file_is_read_back_as_it_was(tmp_path):
    file = tmp_path / "settings.toml"
    settings = Learner(max_lag=1, resume=True, ppo=PPO(rates=(0.1, 0.2)), task=Task(robot="usst"), run="r")
    whole = Whole(run="r", panel=True, task=Task(robot="usst"), learner=LearnerOptions(max_lag=1))
    save_settings(file, to_tables(settings, "learner"))
    save_settings(tmp_path / "whole.toml", to_tables(whole, "local"))

    assert load_learner(file=str(file)) == settings
    assert load_whole("--config", str(tmp_path / "whole.toml")) == whole
    assert tomllib.loads((tmp_path / "whole.toml").read_text()).keys() == {
        *("run", "actors", "task", "learner", "local")
    }


def test_saving_one_programs_settings_leaves_the_others_as_they_were(tmp_path):
    file = tmp_path / "settings.toml"
    save_settings(file, {"learner": {"max_lag": 1, "limit": 2.0}, "actor": {"envs": 3}})
    save_settings(file, {"run": "r", "learner": {"max_lag": 4}})

    assert tomllib.loads(file.read_text()) == {"run": "r", "learner": {"max_lag": 4}, "actor": {"envs": 3}}
    assert list(tmp_path.iterdir()) == [file]


def test_shared_settings_and_tables_have_names_of_their_own():
    assert not set(SHARED) & set(TABLES)


def lag_and_stage(argv, environ, **files):
    settings = load(Learner, argv, prog="p", section="learner", environ=environ, **files)
    return settings.max_lag, settings.stage


def test_flags_variables_and_a_named_file_override_recorded_settings(toml, tmp_path):
    recorded = tmp_path / "recorded.toml"
    save_settings(recorded, {"learner": {"max_lag": 3, "stage": 3}})
    named = toml("[learner]\nmax_lag = 4")

    def found(*argv, **environ):
        return lag_and_stage(argv, environ, recorded=recorded)

    assert found() == found(TOPSPIN_CONFIG=named) == (3, 3)
    assert found("--max-lag", "5") == found(TOPSPIN_LEARNER__MAX_LAG="5") == (5, 3)
    assert found("--config", named) == (4, 3)


@pytest.mark.parametrize(
    ("argv", "environ", "file"),
    [
        ((), {}, None),
        (("--run", "r"), {"TOPSPIN_CONFIG": "e.toml"}, "e.toml"),
        (("--config", "a.toml", "--run", "r"), {"TOPSPIN_CONFIG": "e.toml"}, "a.toml"),
        (("--config", "a.toml", "--config=b.toml"), {}, "b.toml"),
    ],
)
def test_the_named_file_is_the_flags_or_else_the_environments(argv, environ, file):
    assert named_file(argv, environ) == (Path(file) if file else None)


def test_settings_beneath_count_where_nothing_else_gives_a_value(toml, tmp_path):
    beneath = tmp_path / "beneath.toml"
    save_settings(beneath, {"learner": {"max_lag": 3, "stage": 3}})
    named = toml("[learner]\nmax_lag = 4")

    def found(*argv, **environ):
        return lag_and_stage(argv, environ, beneath=beneath)

    assert found() == (3, 3)
    assert found("--config", named) == found(TOPSPIN_CONFIG=named) == (4, 3)
    assert found("--max-lag", "5") == (5, 3)
