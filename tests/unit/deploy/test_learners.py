import subprocess
import sys
from pathlib import Path
from threading import Event

import pytest

from deploy.learners import environment_of, first_failure, room_for_sockets, watch

WAITS = "import time; time.sleep(60)"


@pytest.fixture
def processes():
    started = []

    def start(*programs):
        started.extend(subprocess.Popen([sys.executable, "-c", program]) for program in programs)
        return started

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_a_group_that_is_done_has_not_failed(processes):
    assert watch(processes("pass", "pass"), Event()) is None


def test_the_first_failure_ends_the_others(processes, monkeypatch):
    monkeypatch.setattr("deploy.learners.OTHERS_END_S", 0.1)
    started = processes(WAITS, "raise SystemExit(2)")
    assert watch(started, Event()) == (1, 2)
    assert started[0].poll() is not None


def test_of_several_that_failed_it_names_the_one_that_began_it(processes):
    lost, killed = processes("raise SystemExit(1)", "import os; os.kill(os.getpid(), 9)")
    for process in (lost, killed):
        process.wait()
    assert first_failure([lost, killed]) == (1, -9)


def test_a_stop_reaches_every_rank(processes):
    stop = Event()
    stop.set()
    started = processes(WAITS, WAITS)
    watch(started, stop)
    assert [process.returncode for process in started] == [-15, -15]


def test_ranks_find_each_other_on_this_machine_only():
    told = environment_of(1, 3, Path("/tmp/group"), {"PATH": "/bin"})
    assert told == {
        "PATH": "/bin",
        "RANK": "1",
        "WORLD_SIZE": "3",
        "GROUP_FILE": "/tmp/group",
    }


def test_sockets_have_room_under_a_long_name_of_temporary_files():
    long = f"/scratch/{'x' * 90}"
    deepest = Path(room_for_sockets(long)) / "topspin-12345678" / "group-1000000"

    assert len(str(deepest)) < 108
    assert room_for_sockets("/var/tmp") == "/var/tmp"
