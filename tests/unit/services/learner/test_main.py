"""The learner's command: which settings and which checkpoint it starts from."""

import pytest

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
