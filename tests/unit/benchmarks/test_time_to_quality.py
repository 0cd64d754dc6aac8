"""When the goal is reached, and what several seeds come to."""

import json
import shutil
from threading import Event, Timer

import pytest

from benchmarks import time_to_quality
from benchmarks.time_to_quality import (
    Goal,
    TimeToQualityConfig,
    first_passage,
    kept,
    match_flags,
    measured,
    spread,
    train,
)
from common.errors import ReportedError
from common.evaluation.config import MatchConfig
from common.policy.box import BOX
from common.policy.folder import load_policy
from common.service.config import load
from common.service.run_folder import RunFolder

GOAL = Goal(0.81, 0.31)
MET = {"return_rate": "0.82", "target_error_mean": "0.30"}
MISSED = {"return_rate": "0.80", "target_error_mean": "0.20"}


@pytest.mark.parametrize(
    ("returned", "error", "reached"),
    [("0.81", "0.31", True), ("0.80", "0.20", False), ("0.95", "0.32", False), ("0.0", "", False)],
)
def test_the_goal_is_reached_if_both_figures_are(returned, error, reached):
    row = {"return_rate": returned, "target_error_mean": error}

    assert GOAL.is_met(row) is reached


@pytest.mark.parametrize(
    ("curve", "asked", "confirmed", "passage"),
    [
        ([], 0, True, None),
        ([MISSED], 0, True, None),
        ([MET], 0, True, MET),
        ([MET], 0, False, None),  # lucky balls
        ([MET], 1, True, None),  # looked at before
        ([MET, MISSED], 0, True, None),  # its policy is no longer at hand
    ],
)
def test_a_passage_counts_only_if_other_balls_confirm_it(curve, asked, confirmed, passage):
    assert first_passage(curve, asked, GOAL, lambda _: confirmed) == passage


def test_a_policy_that_misses_the_goal_plays_no_other_balls():
    def fails(_):
        raise AssertionError("it was measured")

    first_passage([MISSED], 0, GOAL, fails)


def test_runs_that_missed_the_goal_count_as_slower_than_all_others():
    runs = [
        {"reached": True, "minutes": 8.0},
        {"reached": False, "minutes": 3.0},
        {"reached": True, "minutes": 6.5},
    ]

    assert spread(runs, "minutes") == {"median": 8.0, "lowest": 6.5, "highest": None}
    assert spread(runs[1:2], "minutes") == {"median": None, "lowest": None, "highest": None}


def test_a_run_that_is_there_is_not_taken_for_a_new_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.of("old")
    folder.create()
    folder.config.write_text("")

    with pytest.raises(ReportedError, match="is there already, and its curve is older; choose another --run"):
        train(TimeToQualityConfig(), "old", 0, Event())


def version_of(policy):
    return json.loads((policy / "contract.json").read_text())["version"]


def test_only_the_policy_that_a_row_measured_confirms_it_and_a_better_one_does_not_take_its_place(tmp_path):
    folder = RunFolder(tmp_path)
    assert kept(folder, {"version": "0"}, wait_s=0.0) is None
    shutil.copytree(BOX / "mild", folder.best_policy)
    version = version_of(folder.best_policy)
    assert kept(folder, {"version": str(version + 1)}, wait_s=0.0) is None

    copy = kept(folder, {"version": str(version)}, wait_s=0.0)
    shutil.rmtree(folder.best_policy)
    shutil.copytree(BOX / "default", folder.best_policy)

    assert version_of(copy) == version != version_of(folder.best_policy)
    assert load_policy(copy).contract == load_policy(BOX / "mild").contract


def test_a_policy_that_is_written_a_moment_after_its_row_is_waited_for(tmp_path):
    folder = RunFolder(tmp_path)
    version = version_of(BOX / "mild")
    writer = Timer(0.3, shutil.copytree, (BOX / "mild", folder.best_policy))
    writer.start()

    assert kept(folder, {"version": str(version)}, wait_s=20.0) is not None
    writer.join()


def test_a_policy_is_measured_under_the_conditions_of_its_training():
    flags = match_flags(BOX / "default")
    found = dict(zip(flags[::2], flags[1::2], strict=True))

    assert found["--launch"] == "all"
    assert (found["--flight"], found["--randomization"], found["--collision"]) == (
        "full",
        "standard",
        "tailored",
    )
    load(MatchConfig, flags, prog="p", section="evaluate")  # all are flags of the command


def test_a_seed_that_was_measured_is_not_trained_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trained = []

    def train(config, name, seed, stop):
        trained.append(name)
        RunFolder.of(name).create()
        return {"reached": True, "minutes": 1.5 + seed, "frames": 7}

    monkeypatch.setattr(time_to_quality, "train", train)
    config = TimeToQualityConfig(run="r")
    first = [measured(config, f"r-{seed}", seed, Event()) for seed in (0, 1)]
    again = [measured(config, f"r-{seed}", seed, Event()) for seed in (0, 1, 2)]

    assert trained == ["r-0", "r-1", "r-2"]
    assert again[:2] == first
    measured(config.model_copy(update={"more": "--task.launch strong"}), "r-0", 0, Event())
    assert trained[-1] == "r-0"
