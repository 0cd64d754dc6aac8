"""When the goal is reached, and what several seeds come to."""

import csv
import json
from threading import Event

import pytest

from benchmarks import time_to_quality
from benchmarks.time_to_quality import (
    Goal,
    TimeToQualityConfig,
    first_passage,
    main,
    match_flags,
    measured,
    spread,
    train,
)
from common.errors import ReportedError
from common.evaluation.config import MatchConfig
from common.policy.box import BOX
from common.service.config import load, save_settings, to_tables
from common.service.run_folder import RunFolder
from deploy.config import settings

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


LATER = MET | {"frames": "9"}


@pytest.mark.parametrize(
    ("curve", "confirmed", "passage"),
    [
        ([], [], None),
        ([MISSED], [], None),
        ([MET], [True], MET),
        ([MET], [False], None),  # lucky balls
        ([MISSED, MET, LATER], [True], MET),  # the first
        ([MET, MISSED, LATER], [False, True], LATER),
    ],
)
def test_the_first_row_that_other_balls_confirm_is_the_passage(curve, confirmed, passage):
    answers = iter(confirmed)

    assert first_passage(curve, GOAL, lambda _: next(answers)) == passage
    assert list(answers) == []


def test_a_policy_that_misses_the_goal_plays_no_other_balls():
    def fails(_):
        raise AssertionError("it was measured")

    first_passage([MISSED], GOAL, fails)


def test_runs_that_missed_the_goal_count_as_slower_than_all_others():
    runs = [
        {"reached": True, "minutes": 8.0},
        {"reached": False, "minutes": 3.0},
        {"reached": True, "minutes": 6.5},
    ]

    assert spread(runs, "minutes") == {"median": 8.0, "lowest": 6.5, "highest": None}
    assert spread(runs[1:2], "minutes") == {"median": None, "lowest": None, "highest": None}


class Trained:
    """A training that has ended before it is looked at."""

    returncode = 0

    def __init__(self, command, **_):
        self.command = command

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def poll(self):
        return self.returncode


ROW = {"version": 7, "frames": 9_000_000, "stage": 3, "catch_rate": 0.99, "return_after_catch": 0.85}


def write_curve(folder, *rows):
    with folder.evaluations.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Commands of trainings that end at once; each leaves two rows that meet the goal."""
    monkeypatch.chdir(tmp_path)
    commands = []

    def popen(command, **_):
        commands.append(command)
        folder = RunFolder.of(command[command.index("--run") + 1])
        folder.create()
        if "--resume" not in command:
            text = command[command.index("--run") :]
            save_settings(folder.config, to_tables(settings(text, "p"), "local"))
        write_curve(folder, ROW | MET, ROW | MET | {"version": 8, "frames": 9_500_000})
        return Trained(command)

    monkeypatch.setattr(time_to_quality.subprocess, "Popen", popen)
    return commands


def exam(monkeypatch, passes):
    """Let policies of these versions meet the goal on other balls; return what was measured."""
    measured = []

    def measure(policy, seed):
        measured.append((policy.name, seed))
        is_good = policy.name in passes
        return {"return_rate": 0.9 if is_good else 0.5, "return_after_catch": 0.9, "target_error_mean": 0.2}

    monkeypatch.setattr(time_to_quality, "measure", measure)
    return measured


def test_each_row_is_confirmed_by_its_own_policy_whatever_is_the_best(started, monkeypatch):
    measured = exam(monkeypatch, {"00000008"})

    found = train(TimeToQualityConfig(), "r", 4, Event())

    assert (found["reached"], found["frames"], found["seed"]) == (True, 9_500_000, 4)
    assert [name for name, _ in measured] == ["00000007", "00000008", "00000008"]
    assert len({seed for _, seed in measured}) == 2  # the reported balls are others again
    assert started[0][-1] == "off"
    assert started[0][7:9] == ["--evaluator.keep-policies", "true"]


def test_a_run_whose_frames_were_spent_before_its_passage_was_noted_has_it_all_the_same(started, monkeypatch):
    exam(monkeypatch, {"00000007"})
    train(TimeToQualityConfig(more="--frames 9500000"), "r", 0, Event())

    found = train(TimeToQualityConfig(more="--frames 9500000"), "r", 0, Event(), resumes=True)

    assert started[1][3:6] == ["--run", "r", "--resume"]
    assert (found["reached"], found["frames"]) == (True, 9_000_000)


def test_a_run_of_other_settings_is_not_resumed(started, monkeypatch):
    exam(monkeypatch, {"00000007"})
    train(TimeToQualityConfig(), "r", 0, Event())

    with pytest.raises(ReportedError, match="minibatch 2048; choose another --run"):
        train(TimeToQualityConfig(more="--learner.ppo.minibatch 512"), "r", 0, Event(), resumes=True)
    assert len(started) == 1


def test_a_seed_that_was_stopped_says_nothing_and_is_trained_anew(started, monkeypatch, capsys):
    exam(monkeypatch, {"00000007"})
    stop = Event()
    stop.set()
    assert train(TimeToQualityConfig(), "r", 0, stop) is None
    RunFolder.of("r").report.joinpath("mine.txt").write_text("kept")

    assert train(TimeToQualityConfig(), "r", 0, Event())["reached"]
    assert RunFolder.of("r-aside-1").report.joinpath("mine.txt").read_text() == "kept"
    assert "r was stopped, or has other settings: moved to runs/r-aside-1" in capsys.readouterr().err
    assert "--resume" not in started[1]


def test_a_stop_within_a_seed_does_not_count_it_as_one_that_missed_the_goal(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    found = iter([{"reached": True, "minutes": 8.0, "frames": 7}, None])
    monkeypatch.setattr(time_to_quality, "train", lambda *_: RunFolder.of("r-0").create() or next(found))

    assert main(TimeToQualityConfig(seeds=5, run="r", json_line=True), Event()) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["reached"], printed["seeds"], printed["minutes"]["median"]) == (1, 1, 8.0)


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
