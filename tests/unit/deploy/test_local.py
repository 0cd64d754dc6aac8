"""The last line of a run whose learner failed, the flags of its restart, and where a panel is shown."""

import os
import pty
import time
from threading import Event

import pytest
from rich.console import Console

from common.service.run_folder import RunFolder
from deploy.config import DeployConfig
from deploy.prepare import PreparedRun, RunFailedError, link_to_learner
from deploy.run import LEARNER, conclude, shows_panel
from deploy.supervisor import Spec, Supervisor


def a_run(folder):
    return PreparedRun(
        "r", DeployConfig(), RunFolder(folder), link_to_learner(DeployConfig(), "tcp/127.0.0.1:1")
    )


def has_checkpoint(run):
    run.folder.checkpoints.mkdir(parents=True)
    (run.folder.checkpoints / "00000007.safetensors").touch()


@pytest.fixture
def failed(tmp_path, monkeypatch):
    """The supervisor of a learner that has failed at its start."""
    (tmp_path / "stand_in.py").write_text("import sys\nprint('disk full', flush=True)\nsys.exit(1)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.getcwd()}")
    supervisor = Supervisor([Spec(LEARNER, "learner", ("stand_in",), True, keeps_run=True)], tmp_path)
    deadline = time.monotonic() + 20.0
    while not supervisor.has_ended(LEARNER):
        assert time.monotonic() < deadline
        supervisor.watch(time.monotonic())
        time.sleep(0.02)
    yield supervisor
    supervisor.stop([LEARNER], 1.0)


def test_the_last_line_of_a_failed_run_says_how_to_go_on(tmp_path, failed):
    run = a_run(tmp_path / "r")
    has_checkpoint(run)

    with pytest.raises(RunFailedError) as caught:
        conclude(run, failed, None, Event(), "topspin train")

    assert (
        str(caught.value)
        == "the learner ended with status 1: disk full; go on with: topspin train --run r --resume"
    )


def test_without_a_checkpoint_there_is_nothing_to_go_on_from(tmp_path, failed):
    with pytest.raises(RunFailedError, match=r"the learner ended with status 1: disk full$"):
        conclude(a_run(tmp_path / "r"), failed, None, Event(), "topspin train")


def test_a_restarted_learner_goes_on_from_its_checkpoint_if_there_is_one(tmp_path):
    run = a_run(tmp_path / "r")
    learner = run.specs()[0]

    assert learner.again() == ()
    has_checkpoint(run)
    assert learner.again() == ("--resume",)
    assert "--resume" not in learner.arguments


@pytest.mark.parametrize(
    ("environment", "in_terminal", "in_file"),
    [
        ({"TERM": "xterm"}, True, False),
        ({"TERM": "dumb"}, False, False),
        ({"TERM": "dumb", "FORCE_COLOR": "1"}, False, False),
        ({"TERM": "xterm", "FORCE_COLOR": "1"}, True, False),
        ({"TERM": "xterm", "TTY_COMPATIBLE": "1"}, True, False),
        ({"TERM": "xterm", "TTY_COMPATIBLE": "0"}, False, False),
        ({"TERM": "xterm", "TTY_INTERACTIVE": "0"}, False, False),
    ],
)
def test_the_panel_is_shown_only_in_a_terminal_that_can_show_it(
    tmp_path, monkeypatch, environment, in_terminal, in_file
):
    for name in ("TERM", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    ours, theirs = pty.openpty()
    try:
        with os.fdopen(theirs, "w") as terminal, (tmp_path / "log").open("w") as file:
            shown = [shows_panel("auto", Console(file=output)) for output in (terminal, file)]
            off = shows_panel("off", Console(file=terminal))
    finally:
        os.close(ours)

    assert shown == [in_terminal, in_file]
    assert off is False


def test_a_panel_that_is_wanted_needs_a_cursor(tmp_path, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    with (tmp_path / "log").open("w") as file:
        assert shows_panel("on", Console(file=file, force_terminal=True)) is False
