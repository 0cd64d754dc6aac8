"""When the goal is reached, and what several seeds come to."""

import json
import shutil
from threading import Event

import pytest

from benchmarks.time_to_quality import Goal, TimeToQualityConfig, first_passage, is_at_hand, spread, train
from common.errors import ReportedError
from common.policy.box import BOX
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


def test_only_the_policy_that_a_row_measured_confirms_it(tmp_path):
    folder = RunFolder(tmp_path)
    assert not is_at_hand(folder, {"version": "0"})
    shutil.copytree(BOX / "mild", folder.best_policy)
    version = json.loads((folder.best_policy / "contract.json").read_text())["version"]

    assert is_at_hand(folder, {"version": str(version)})
    assert not is_at_hand(folder, {"version": str(version + 1)})
