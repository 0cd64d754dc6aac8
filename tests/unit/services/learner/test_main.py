"""The learner's command: which settings and which checkpoint it starts from."""

import pytest

from common.errors import ConfigError
from services.learner.__main__ import settings


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs/r/checkpoints").mkdir(parents=True)
    return tmp_path / "runs/r"


def test_the_same_command_starts_a_run_and_goes_on_with_it_once_there_is_a_checkpoint(folder):
    first = settings(["--run", "r", "--auto-resume"])
    (folder / "checkpoints" / "00000007.safetensors").touch()
    (folder / "config.toml").write_text("seed = 5\n")
    second = settings(["--run", "r", "--auto-resume"])
    without = settings(["--run", "r"])

    assert (first.resume, second.resume, without.resume) == (False, True, False)
    assert second.seed == 5  # a run that goes on has its own settings
    assert second.run == "r"


def test_a_run_that_goes_on_keeps_its_settings_beneath_those_of_a_named_file(folder, tmp_path):
    (folder / "checkpoints" / "00000007.safetensors").touch()
    (folder / "config.toml").write_text("seed = 5\n[learner.ppo]\nclip = 0.3\n")
    (tmp_path / "fleet.toml").write_text('log_level = "debug"\n[learner.ppo]\nminibatch = 512\n')

    found = settings(["--run", "r", "--auto-resume", "--config", "fleet.toml"])

    assert (found.seed, found.ppo.clip, found.ppo.minibatch, found.log_level) == (5, 0.3, 512, "debug")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--run", "latest"), "learner: run 'latest', which is now 'r'; allowed: a run's own name"),
        (("--id", "3"), "learner: id '3'; allowed: 0, which is the learner that keeps the run"),
        (
            ("--curriculum.stage-1", "0", "--curriculum.catch-gate", "0.5"),
            "catch_gate 0.5 without stage 1; allowed: 0",
        ),
    ],
)
def test_settings_that_would_be_ignored_are_refused(folder, flags, said):
    (folder / "config.toml").touch()
    with pytest.raises(ConfigError) as error:
        settings(flags)

    assert said in str(error.value)
