import pytest

from common.errors import ConfigError
from common.service.config import save_settings, to_tables
from common.service.run_folder import RunFolder
from services.learner.__main__ import settings
from services.learner.config import IntakeConfig, LearnerConfig, PPOConfig


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def recorded(run="r", **values):
    """Write the config.toml of a run."""
    file = RunFolder.of(run).config
    file.parent.mkdir(parents=True)
    config = LearnerConfig(**{"run": run} | values)
    save_settings(file, to_tables(config, "learner") | {"actor": {"envs": 3}})
    return file


def test_a_resumed_learner_has_its_recorded_settings_except_for_new_flags():
    recorded(ppo=PPOConfig(clip=0.1), seed=5, minutes=10)

    found = settings(["--run", "r", "--resume", "--minutes", "20"])

    assert found == LearnerConfig(run="r", resume=True, ppo=PPOConfig(clip=0.1), seed=5, minutes=20)
    assert settings(["--run", "r"]) == LearnerConfig(run="r")


def test_a_named_file_replaces_the_recorded_settings(tmp_path):
    recorded(seed=5)
    save_settings(tmp_path / "other.toml", {"seed": 6})

    assert settings(["--run", "r", "--resume", "--config", "other.toml"]).seed == 6


def test_a_copied_folder_is_resumed_under_its_own_name():
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
def test_new_flags_are_checked_together_with_recorded_settings_not_defaults(values, flags):
    recorded(**values)

    settings(["--run", "r", "--resume", *flags])
    with pytest.raises(ConfigError):
        settings(["--run", "other", *flags])


def test_a_run_without_recorded_settings_is_resumed_with_the_given_ones():
    assert settings(["--run", "r", "--resume", "--seed", "3"]) == LearnerConfig(run="r", resume=True, seed=3)


@pytest.mark.parametrize(
    ("dataset", "frames"),
    [(32, 2048), (8192, 2048), (16_384, 4096), (32_768, 8192), (131_072, 8192), (10**7, 8192)],
)
def test_a_minibatch_is_a_quarter_of_the_dataset_within_bounds(dataset, frames):
    assert PPOConfig().minibatch_of(dataset) == frames
    assert PPOConfig().largest_minibatch == 8192
    assert PPOConfig(minibatch=512).minibatch_of(dataset) == PPOConfig(minibatch=512).largest_minibatch == 512


@pytest.mark.parametrize("frames", [1, 31])
def test_a_minibatch_of_a_few_frames_is_refused(frames):
    with pytest.raises(ValueError, match=f"minibatch {frames}; allowed: 0, or 32 and more"):
        PPOConfig(minibatch=frames)
