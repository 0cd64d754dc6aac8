"""The ablation's arms differ in what they name alone, and are compared seed by seed."""

import json
import math
import shutil
from threading import Event

import pytest

from benchmarks import trainings
from benchmarks.ablation import ARMS, AblationConfig, differences, main, wanted
from benchmarks.trainings import Wanted, is_measured, keep, made, make
from benchmarks.trainings import differences as settings_apart
from common.errors import ReportedError
from common.service.config import save_settings, to_tables
from common.service.process import FAILED
from common.service.run_folder import RunFolder
from deploy.config import settings
from topspin.report.groups import experiment


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainings, "KEPT", tmp_path / "kept")


def settings_of(arm):
    return experiment(
        to_tables(settings(("--run", "r", *wanted(AblationConfig(), arm, 0).flags), "p"), "local")
    )


@pytest.mark.parametrize(
    ("arm", "named"),
    [
        ("stage 3 alone", {"learner.curriculum.first_stage"}),
        ("simulator's contacts", {"task.collision"}),
    ],
)
def test_an_arm_differs_from_the_curriculum_in_what_it_names_alone(arm, named):
    apart = settings_apart(settings_of(arm), settings_of("curriculum"))

    assert {one.split()[0] for one in apart} == named


def test_no_arm_has_what_acts_in_stage_3_alone():
    for arm in ARMS:
        found = settings_of(arm)
        assert found["experience.leads_home"] is False
        assert found["task.reward.landing_bonus"] == 0
        assert found["learner.curriculum.stage_shares"] == [0.14, 0.48, 0.38]


def finished(training: Wanted, returned, balls=2000, collision="tailored"):
    folder = RunFolder.of(training.name)
    folder.create()
    save_settings(folder.config, to_tables(settings(("--run", training.name, *training.flags), "p"), "local"))
    rates = {"return_rate": returned, "return_after_catch": returned, "target_error_mean": None}
    measured = rates | {"frames": 7, "rallies": balls, "collision": collision}
    folder.final.write_text(json.dumps(measured))
    folder.checkpoints.joinpath("large").write_text("x")
    return folder


def test_differences_are_students_of_the_seeds_that_both_arms_have(capsys):
    config = AblationConfig(train=False, json_line=True)
    for seed, (one, other) in enumerate(((0.5, 0.6), (0.6, 0.8), (0.7, 0.8))):
        finished(wanted(config, "curriculum", seed), one)
        finished(wanted(config, "stage 3 alone", seed), other)

    assert main(config, Event()) == 0
    found = json.loads(capsys.readouterr().out)
    (apart,) = [one for one in found["differences"] if one["measure"] == "return_rate"]
    # Differences 0.1, 0.2, 0.1: mean 0.1333, standard deviation 0.0577, t of 2 degrees of freedom 4.3027
    half = 4.3027 * 0.057735 / math.sqrt(3)
    assert (apart["first"], apart["second"], apart["pairs"]) == ("curriculum", "stage 3 alone", 3)
    assert apart["mean"] == pytest.approx(0.1333, abs=1e-4)
    assert (apart["low"], apart["high"]) == pytest.approx((0.1333 - half, 0.1333 + half), abs=2e-4)
    assert found["arms"]["curriculum"]["median"]["return_rate"] == 0.6
    assert found["arms"]["simulator's contacts"]["runs"] == []


def test_a_policy_of_other_contacts_is_measured_with_the_measured_bounces_once(monkeypatch, capsys):
    config = AblationConfig(train=False, json_line=True, seeds=(3,))
    finished(wanted(config, "curriculum", 3), 0.7)
    folder = finished(wanted(config, "simulator's contacts", 3), 0.9, collision="original")
    keep(folder, trainings.KEPT)
    folder.latest_policy.mkdir(parents=True)
    evaluations = []

    def evaluated(policy, flags):
        evaluations.append(flags)
        return {
            "return_rate": 0.5,
            "return_after_catch": 0.6,
            "target_error_mean": 0.4,
            "collision": "tailored",
        }

    monkeypatch.setattr(trainings, "evaluated", evaluated)
    returned = []
    for _ in range(2):
        main(config, Event())
        arms = json.loads(capsys.readouterr().out)["arms"]
        returned.append(
            [arms[arm]["runs"][0]["return_rate"] for arm in ("curriculum", "simulator's contacts")]
        )
    shutil.rmtree(folder.root)  # as in a clone
    main(config, Event())

    assert returned == [[0.7, 0.5]] * 2
    assert (
        json.loads(capsys.readouterr().out)["arms"]["simulator's contacts"]["runs"][0]["return_rate"] == 0.5
    )
    assert evaluations == [["--collision", "tailored", "--rallies", "2000", "--seed", "3"]]


def test_a_run_that_is_another_training_does_not_end_the_study(monkeypatch, capsys):
    config = AblationConfig(json_line=True, seeds=(0,))
    finished(wanted(config, "curriculum", 0), 0.7, balls=100)
    started = []
    monkeypatch.setattr(trainings, "_train", lambda one, stop: (made(one) and started.append(one.name)) or "")
    finished(wanted(config, "stage 3 alone", 0), 0.6)

    assert main(config, Event()) == FAILED
    told = capsys.readouterr()
    assert started == ["ablation-stage-3-alone-0"]
    assert told.err.count("final_rallies 100; choose another --run") == 1
    assert json.loads(told.out)["arms"]["curriculum"]["runs"] == []
    assert json.loads(told.out)["arms"]["stage 3 alone"]["median"]["return_rate"] == 0.6


def test_one_seed_has_no_difference():
    one = {"seed": 0, "return_rate": 0.5, "return_after_catch": 0.5, "target_error_mean": 0.5}

    assert differences({"a": [one], "b": [one]}) == []


def test_of_a_training_that_has_ended_settings_curve_and_measures_are_kept_and_it_is_not_made_again(
    monkeypatch,
):
    one = wanted(AblationConfig(), "curriculum", 0)
    folder = finished(one, 0.5)
    folder.evaluations.write_text("frames\n7\n")
    keep(folder, trainings.KEPT)
    copy = RunFolder(trainings.KEPT / one.name)
    assert {file.relative_to(copy.root).as_posix() for file in copy.root.rglob("*") if file.is_file()} == {
        *("config.toml", "report/final.json", "report/evaluations.csv")
    }
    folder.final.unlink()  # as in a clone

    assert made(one).root == copy.root
    monkeypatch.setattr(trainings.subprocess, "Popen", None)  # nothing is started
    assert make([one], Event()) == []


def test_a_training_that_was_stopped_is_not_made(monkeypatch):
    one = wanted(AblationConfig(), "curriculum", 0)
    folder = finished(one, 0.5)
    folder.final.write_text(json.dumps({"frames": 7}))

    assert not is_measured(folder)
    assert made(one) is None


def test_a_run_with_another_number_of_measured_balls_is_not_taken_for_it():
    one = wanted(AblationConfig(), "curriculum", 0)
    finished(one, 0.5, balls=100)

    with pytest.raises(ReportedError, match="final_rallies 100; choose another --run"):
        made(one)
