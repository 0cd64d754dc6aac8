import os
import signal
import time

import pytest

from common.service.process import BAD_CONFIG, SECOND_SIGNAL_AFTER_S
from deploy.child import Assignment
from deploy.supervisor import (
    KEEPER_DEATHS,
    RESTART_PAUSE_MAX_S,
    RESTART_PAUSE_S,
    Spec,
    Supervisor,
    is_a_new_row,
    next_start,
    restart_pause,
)
from deploy.topology import ROLES
from tests.waiting import wait_until


def test_pauses_before_restarts_double_up_to_a_bound():
    pauses = [restart_pause(deaths) for deaths in range(1, 12)]

    assert pauses[:3] == [RESTART_PAUSE_S, 2 * RESTART_PAUSE_S, 4 * RESTART_PAUSE_S]
    assert pauses[-1] == RESTART_PAUSE_MAX_S
    assert pauses == sorted(pauses)


WORKER = Spec("actor-0", "actor", ("m",), restart=True)
KEEPER = Spec("learner-0", "learner", ("m",), restart=True, keeps_run=True)


@pytest.mark.parametrize(
    ("spec", "status", "life_s", "deaths", "pause"),
    [
        (WORKER, -9, 1.0, 1, RESTART_PAUSE_S),
        (WORKER, 1, 1.0, 99, RESTART_PAUSE_MAX_S),
        (WORKER, BAD_CONFIG, 99.0, 1, None),
        (KEEPER, -9, 1.0, 1, RESTART_PAUSE_S),
        (KEEPER, -9, 1.0, 3, 4 * RESTART_PAUSE_S),
        (KEEPER, -9, 1.0, KEEPER_DEATHS + 1, None),
        (KEEPER, 0, 99.0, 1, None),
        (KEEPER, 1, 1.0, 1, None),  # a taken port: the next one would fail in the same way
        (KEEPER, 1, 99.0, 1, RESTART_PAUSE_S),
    ],
)
def test_a_dead_process_is_restarted_where_that_can_help(spec, status, life_s, deaths, pause):
    assert next_start(spec, status, life_s, deaths) == pause


@pytest.mark.parametrize(
    ("spec", "status", "life_s", "has_made", "is_new"),
    [
        (WORKER, -9, 19.0, False, False),
        (WORKER, -9, 21.0, False, True),
        (KEEPER, -9, 30.0, True, True),  # killed from outside, after a checkpoint: the run has gone on
        (KEEPER, -9, 30.0, False, False),
        (KEEPER, 1, 30.0, True, False),  # a fault of its own would come back for ever
        (KEEPER, 1, 601.0, False, True),
    ],
)
def test_a_death_after_useful_work_begins_a_new_row(spec, status, life_s, has_made, is_new):
    assert is_a_new_row(spec, status, life_s, has_made) is is_new


def test_an_assignment_survives_the_pipe():
    assignment = Assignment("runs/r/logs/actor-0.log", ("--id", "0", "--config", "a\nb"))

    line = assignment.to_line()

    assert line.count(b"\n") == 1
    assert Assignment.from_line(line) == assignment


@pytest.fixture
def service(tmp_path, monkeypatch):
    """A module that logs a line and ends as its arguments say."""
    (tmp_path / "stand_in.py").write_text(
        "import sys, time\n"
        "print('started', *sys.argv[1:], flush=True)\n"
        "sys.exit(int(sys.argv[2])) if sys.argv[1] == 'end' else time.sleep(600)\n"
    )
    root = os.getcwd()
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{root}")
    return "stand_in"


def kept(tmp_path, *arguments, restart=True):
    return Supervisor([Spec("worker-0", "generator", arguments, restart)], tmp_path)


def test_a_process_that_dies_is_restarted_and_its_log_continues(tmp_path, service):
    supervisor = kept(tmp_path, service, "stay")
    child, log = supervisor.children["worker-0"], tmp_path / "worker-0.log"
    wait_until(lambda: "started" in log.read_text())
    os.kill(child.process.pid, signal.SIGKILL)
    wait_until(lambda: (supervisor.watch(time.monotonic()), child.restarts == 1)[1])
    wait_until(lambda: log.read_text().count("started stay") == 2)
    alive = child.process.poll() is None
    supervisor.stop(["worker-0"], 5.0)

    assert alive
    assert child.exits == [-signal.SIGKILL]
    assert child.process.poll() is not None


def test_a_process_gets_the_environment_but_no_settings_from_it(tmp_path, service, monkeypatch):
    (tmp_path / "stand_in.py").write_text(
        "import os\nprint('found', os.environ.get('TOPSPIN_CONFIG'), os.environ.get('ELSE'), flush=True)\n"
    )
    monkeypatch.setenv("TOPSPIN_CONFIG", "other.toml")
    monkeypatch.setenv("ELSE", "kept")
    supervisor = kept(tmp_path, service)
    wait_until(lambda: supervisor.status_of("worker-0") is not None)
    supervisor.stop(["worker-0"], 1.0)

    assert supervisor.last_line("worker-0") == "found None kept"


def test_a_process_that_cannot_use_its_settings_is_not_restarted(tmp_path, service):
    supervisor = kept(tmp_path, service, "end", str(BAD_CONFIG))
    wait_until(lambda: (supervisor.watch(time.monotonic()), supervisor.has_bad_config())[1] == "worker-0")
    supervisor.watch(time.monotonic() + 100.0)
    supervisor.stop(["worker-0"], 1.0)

    assert supervisor.children["worker-0"].restarts == 0
    assert supervisor.last_line("worker-0") == f"started end {BAD_CONFIG}"


def test_a_process_ends_with_the_holder_of_its_pipe(tmp_path, service):
    supervisor = kept(tmp_path, service, "stay")
    process = supervisor.children["worker-0"].process
    wait_until(lambda: "started" in (tmp_path / "worker-0.log").read_text())

    process.stdin.close()

    assert process.wait(20) == -signal.SIGTERM


def test_the_process_that_keeps_the_run_gets_more_flags_at_a_restart(tmp_path, service):
    spec = Spec("worker-0", "learner", (service, "stay"), True, keeps_run=True, again=lambda: ("--resume",))
    supervisor = Supervisor([spec], tmp_path)
    log = tmp_path / "worker-0.log"
    wait_until(lambda: "started stay" in log.read_text())
    supervisor.kill("worker-0")
    wait_until(lambda: (supervisor.watch(time.monotonic()), "started stay --resume" in log.read_text())[1])
    ended = supervisor.has_ended("worker-0")
    supervisor.stop(["worker-0"], 5.0)

    assert not ended


def test_the_second_signal_of_a_learner_whose_workers_end_slowly_does_not_interrupt_its_last_checkpoint():
    slowest = max(role.grace_s for role in ROLES if role.name != "learner")

    assert SECOND_SIGNAL_AFTER_S[signal.SIGTERM] > slowest
