"""The ladder's rungs, and what it prints of finished runs."""

import json
import re
from threading import Event

import pytest

from benchmarks import trainings
from benchmarks.ladder import RECIPE, RUNGS, LadderConfig, flags_of, main
from benchmarks.recipe import known_settings
from benchmarks.trainings import differences, is_measured
from common.errors import ReportedError
from common.service.config import save_settings, to_tables
from common.service.process import FAILED
from common.service.run_folder import RunFolder
from deploy.config import settings
from topspin.report.groups import experiment


@pytest.fixture(autouse=True)
def _nothing_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(trainings, "KEPT", tmp_path / "kept")


def settings_of(rung):
    config = settings(("--run", "r", "--recipe", RECIPE, *flags_of(rung)), "p")
    return experiment(to_tables(config, "local"))


def test_the_ladder_leads_from_the_papers_recipe_to_the_default():
    known = known_settings()

    assert differences(settings_of(0), known[RECIPE]) == []
    assert differences(settings_of(len(RUNGS) - 1), known["default"]) == []


@pytest.mark.parametrize("rung", range(1, len(RUNGS)))
def test_each_rung_changes_what_its_flags_name_and_nothing_else(rung):
    changed = differences(settings_of(rung), settings_of(rung - 1))

    named = {flag.replace("-", "_").replace("actor.envs", "environments") for flag in RUNGS[rung].flags}
    assert {change.split()[0] for change in changed} == named


def save_run(folder, rung, seed, *more):
    flags = ("--recipe", RECIPE, *flags_of(rung), "--seed", str(seed), "--frames", "15000000", *more)
    save_settings(folder.config, to_tables(settings(("--run", "r", *flags), "p"), "local"))


@pytest.mark.parametrize(
    ("rung", "more", "said"),
    [
        (6, (), "task.observation.critic privileged"),
        (3, ("--frames", "2000000"), "frames 2000000"),
        (3, ("--seed", "2"), "seed 2"),
        (3, ("--learner.ppo.clip", "0.1"), "learner.ppo.clip 0.1"),
    ],
)
def test_a_run_of_other_settings_is_not_taken_for_a_rung(tmp_path, monkeypatch, capsys, rung, more, said):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.of("ladder-3-1")
    folder.create()
    save_run(folder, rung, 1, *more)
    folder.final.write_text(json.dumps({"return_rate": 0.5, "rallies": 1000}))

    assert main(LadderConfig(train=False, json_line=True), Event()) == FAILED
    told = capsys.readouterr()
    assert re.search(f"is not the training that is wanted: it has .*{said}.*; choose another --run", told.err)
    assert json.loads(told.out)["ladder"] == []


def test_the_number_of_actors_does_not_make_another_rung(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.of("ladder-3-1")
    folder.create()
    save_run(folder, 3, 1, "--actors", "2")
    folder.final.write_text(
        json.dumps(
            {
                "return_rate": 0.5,
                "return_after_catch": 0.6,
                "target_error_mean": 0.4,
                "frames": 15_000_000,
                "rallies": 1000,
            }
        )
    )

    assert main(LadderConfig(train=False), Event()) == 0
    assert capsys.readouterr().out.startswith("3  return_rate 0.5")


def test_measured_runs_are_printed_by_rung(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for rung, seed, rate in ((0, 1, 0.2), (0, 2, 0.4), (3, 1, 0.7)):
        folder = RunFolder.of(f"ladder-{rung}-{seed}")
        folder.create()
        save_run(folder, rung, seed)
        measured = {
            "return_rate": rate,
            "return_after_catch": rate,
            "target_error_mean": 0.5,
            "frames": 1000,
            "rallies": 1000,
        }
        folder.final.write_text(json.dumps(measured))

    assert main(LadderConfig(seeds=(1, 2), train=False, json_line=True), Event()) == 0

    found = json.loads(capsys.readouterr().out)["ladder"]
    assert [(rung["rung"], rung["median"]["return_rate"], len(rung["runs"])) for rung in found] == [
        (0, 0.3, 2),
        (3, 0.7, 1),
    ]


def test_a_training_that_was_stopped_is_not_measured(tmp_path):
    folder = RunFolder(tmp_path)
    assert not is_measured(folder)
    folder.report.mkdir()
    folder.final.write_text(json.dumps({"frames": 1000, "ledger": {}}))
    assert not is_measured(folder)
    folder.final.write_text(json.dumps({"frames": 1000, "return_rate": 0.0}))

    assert is_measured(folder)


def test_a_rung_that_is_not_there_is_refused():
    with pytest.raises(ReportedError, match=f"^no rung {len(RUNGS)}; allowed: 0 to {len(RUNGS) - 1}$"):
        main(LadderConfig(rungs=(len(RUNGS),)), Event())
