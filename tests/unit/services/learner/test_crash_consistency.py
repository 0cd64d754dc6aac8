"""The learner killed at every system call of a save and of a resume leaves the previous state or the new one."""

import dataclasses
import shutil

import numpy as np
import pytest

from common.policy.config import NetworkConfig
from common.policy.contract import contract_of
from common.policy.folder import load_policy, save_policy
from common.service.config import save_settings
from common.service.config_sources import read_toml
from common.service.table import Table, whole_rows
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from services.learner import checkpoint
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.generation import next_generation
from services.learner.run_log import RunLog
from services.learner.training import Training
from tests.crash_points import killed_at_each_call
from tests.unit.services.learner.test_checkpoint import EXTRAS

FEWEST_CALLS = 5  # a save that makes fewer is not what was meant to be tested


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "run"


def putting_back(folder, template):
    def prepare():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(template, folder, symlinks=True)

    return prepare


def at_version(version, fill):
    training = Training(
        PPOConfig(),
        NetworkConfig(units=(8, 8)),
        StageLengths(CurriculumConfig()),
        np.zeros(7, np.float32),
        0,
        observation=TaskConfig().observation,
    )
    training.progress = dataclasses.replace(training.progress, version=version)
    for parameter in training.network.parameters():
        parameter.data.fill_(fill)
    return training


def test_a_killed_save_leaves_the_old_checkpoint_or_the_new_one(tmp_path, folder):
    template = tmp_path / "template"
    for version in (1, 2, 3):
        old = checkpoint.save(template, at_version(version, 0.25), EXTRAS)
    checkpoint.keep(old, template / checkpoint.GOOD)
    new, later, found = at_version(4, 0.5), at_version(5, 0.5), at_version(0, 0.0)

    def save():
        path = checkpoint.save(folder, new, EXTRAS)
        checkpoint.keep(path, folder / checkpoint.GOOD)

    seen = []
    for number in killed_at_each_call(save, putting_back(folder, template)):  # noqa: B007 - counts the calls
        path, extras = checkpoint.restore_newest(folder, found)
        assert extras == EXTRAS
        assert found.progress.version == int(path.stem)
        wanted = {3: 0.25, 4: 0.5}[found.progress.version]
        assert all(np.all(parameter.detach().numpy() == wanted) for parameter in found.network.parameters())
        seen.append(found.progress.version)
        checkpoint.save(folder, later, EXTRAS)  # the next life's save cleans up
        assert list(folder.glob("*.part")) == []

    assert seen == sorted(seen)
    assert set(seen) == {3, 4}
    assert number >= FEWEST_CALLS


def test_a_killed_save_of_a_policy_leaves_the_old_one_or_the_new_one(tmp_path, folder):
    contract = contract_of(
        TaskConfig(),
        ExperienceConfig(),
        NetworkConfig(units=(8, 8)),
        run="r",
        generation=1,
        version=1,
        stage=1,
        frames=1,
    )

    trainings = {version: at_version(version, float(version)) for version in (1, 2)}

    def save(where, version):
        training = trainings[version]
        save_policy(
            where / "latest",
            training.network,
            training.obs_moments,
            contract.model_copy(update={"version": version}),
        )

    save(tmp_path / "template", 1)
    seen = []
    for number in killed_at_each_call(lambda: save(folder, 2), putting_back(folder, tmp_path / "template")):  # noqa: B007
        policy = load_policy(folder / "latest")
        weights = [p.detach().numpy() for n, p in policy.network.named_parameters() if n.startswith("mean.")]
        assert all(np.all(value == policy.contract.version) for value in weights)
        seen.append(policy.contract.version)

    assert set(seen) == {1, 2}
    assert number >= FEWEST_CALLS


def test_a_killed_resume_leaves_curve_settings_and_generation_whole(tmp_path, folder):
    template = tmp_path / "template"
    template.mkdir()
    table = Table(template / "metrics.csv", ("epoch", "loss"))
    for epoch in range(1, 41):
        table.append({"epoch": epoch, "loss": 0.5})
    save_settings(template / "config.toml", {"run": "old", "task": {"rate": 50}})
    first = next_generation(template / ".generation", 0)

    def resume():
        RunLog(folder / "metrics.csv", folder / "tb", folder / "e.csv").truncate(30, 0)
        save_settings(folder / "config.toml", {"run": "new"})
        next_generation(folder / ".generation", 0)

    seen = set()
    for number in killed_at_each_call(resume, putting_back(folder, template)):  # noqa: B007
        epochs = [int(row["epoch"]) for row in whole_rows(folder / "metrics.csv")]
        settings = read_toml(folder / "config.toml")
        assert epochs in (list(range(1, 41)), list(range(1, 31)))
        assert settings["task"] == {"rate": 50}
        assert next_generation(folder / ".generation", 0) > first
        seen.add((len(epochs), settings["run"]))

    assert seen == {(40, "old"), (30, "old"), (30, "new")}
    assert number >= FEWEST_CALLS


def test_a_killed_append_leaves_whole_rows(tmp_path, folder):
    template = tmp_path / "template"
    template.mkdir()
    Table(template / "rows.csv", ("epoch",)).append({"epoch": 1})

    seen = set()
    act = Table(folder / "rows.csv", ("epoch",))
    for _ in killed_at_each_call(lambda: act.append({"epoch": 2}), putting_back(folder, template)):
        seen.add(tuple(row["epoch"] for row in whole_rows(folder / "rows.csv")))

    assert seen == {("1",), ("1", "2")}
