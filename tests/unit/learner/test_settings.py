import pytest

from common.config import ConfigError, record, to_table
from common.run_folder import RunFolder
from services.learner.__main__ import settings
from services.learner.config import LearnerConfig
from services.learner.intake import IntakeConfig
from services.learner.ppo import PPOConfig


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def recorded(run="r", **values):
    """Write the config.toml of a run."""
    file = RunFolder.of(run).config
    file.parent.mkdir(parents=True)
    record(file, {"learner": to_table(LearnerConfig(**{"run": run} | values)), "actor": {"envs": 3}})
    return file


def test_a_resumed_learner_has_the_settings_of_its_run_but_for_the_flags_given_now():
    recorded(ppo=PPOConfig(clip=0.1), seed=5, minutes=10)

    found = settings(["--run", "r", "--resume", "--minutes", "20"])

    assert found == LearnerConfig(run="r", resume=True, ppo=PPOConfig(clip=0.1), seed=5, minutes=20)
    assert settings(["--run", "r"]) == LearnerConfig(run="r")


def test_a_file_that_is_named_takes_the_place_of_what_the_run_recorded(tmp_path):
    recorded(seed=5)
    record(tmp_path / "other.toml", {"learner": {"seed": 6}})

    assert settings(["--run", "r", "--resume", "--config", "other.toml"]).seed == 6


def test_a_copied_folder_is_resumed_as_itself_not_as_what_it_was_copied_from():
    file = recorded(seed=5, folder="runs/r", minutes=1.0)
    file.parent.rename("runs/copy")

    found = settings(["--run", "copy", "--resume"])
    by_folder = settings(["--folder", "runs/copy", "--resume"])

    assert (found.run, found.folder, found.seed) == ("copy", "", 5)
    assert (by_folder.run, by_folder.folder, by_folder.seed) == ("r", "runs/copy", 5)


@pytest.mark.parametrize(
    ("values", "flags"),
    [
        ({"ppo": PPOConfig(learning_rate_min=4e-6)}, ["--ppo.learning-rate-max", "1.2e-5"]),
        ({"intake": IntakeConfig(queue_rollouts=600)}, ["--intake.dataset-rollouts", "300"]),
    ],
)
def test_what_is_given_now_is_judged_beside_the_record_and_not_beside_the_defaults(values, flags):
    recorded(**values)

    settings(["--run", "r", "--resume", *flags])
    with pytest.raises(ConfigError):
        settings(["--run", "other", *flags])


def test_a_run_without_a_record_is_resumed_with_what_is_given():
    assert settings(["--run", "r", "--resume", "--seed", "3"]) == LearnerConfig(run="r", resume=True, seed=3)
