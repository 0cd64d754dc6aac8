import os
import signal
import subprocess
import sys
import time

import pytest

from deploy.watchdog import LOOK_S, MOST_LIMITS, Pulse, Watchdog, cpu_seconds, hung, is_hung, wants_a_core
from tests.waiting import wait_until

LIMIT = 60.0


@pytest.mark.parametrize(
    ("pulse", "now", "hangs"),
    [
        (Pulse(0.0), 59.0, False),
        (Pulse(0.0), 61.0, True),  # it never started to work
        (Pulse(0.0, busy=50.0), 100.0, False),  # it compiles
        (Pulse(0.0, heard=50.0), 100.0, False),
        (Pulse(0.0, heard=50.0), 111.0, True),
        (Pulse(0.0, heard=50.0, busy=110.0), 111.0, False),  # a long update
        (
            Pulse(0.0, heard=0.0, busy=MOST_LIMITS * LIMIT),
            MOST_LIMITS * LIMIT + 1.0,
            True,
        ),  # it turns in a circle
        (Pulse(100.0, heard=50.0), 111.0, False),  # the heartbeat was of its earlier life
    ],
)
def test_a_process_hangs_when_it_is_silent_and_uses_no_cpu_time(pulse, now, hangs):
    assert is_hung(pulse, now, LIMIT) is hangs


def test_while_the_hub_is_silent_only_the_hub_is_judged():
    silent = Pulse(0.0, heard=10.0)
    fresh = Pulse(0.0, heard=99.5)

    assert hung({"learner-0": silent, "actor-0": silent}, "learner-0", 100.0, LIMIT) == ["learner-0"]
    assert hung({"learner-0": Pulse(0.0, 60.0), "actor-0": silent}, "learner-0", 100.0, LIMIT) == []
    assert hung({"learner-0": fresh, "actor-0": silent}, "learner-0", 100.0, LIMIT) == ["actor-0"]
    restarted = Pulse(80.0, heard=99.5)  # the actor could not be heard before
    assert hung({"learner-0": restarted, "actor-0": silent}, "learner-0", 100.0, LIMIT) == []
    assert hung({"learner-0": fresh, "actor-0": silent}, "learner-0", 100.0, 0.0) == []


def test_after_a_stop_of_the_whole_run_nobody_hangs_until_the_limit_has_passed_again():
    """Ctrl-Z stops the watchdog too: when it goes on, all heartbeats are old."""
    watchdog = Watchdog("learner-0", LIMIT, cpu_of=lambda _: 1.0, wants_core=lambda _: False)
    processes = [("learner-0", 1, 0.0)]
    heard = {"learner-0": 10.0}

    assert watchdog.look(processes, heard, 11.0) == []
    stopped_until = 500.0
    looks = [watchdog.look(processes, heard, stopped_until + second) for second in range(60)]
    assert looks == [[]] * 60
    assert watchdog.look(processes, heard, stopped_until + 61.0) == ["learner-0"]


def test_a_process_that_waits_for_a_core_does_not_hang_however_little_it_gets():
    """With too many processes on a machine one got no CPU time for a minute, and was killed again and again."""
    starved = Watchdog("learner-0", LIMIT, cpu_of=lambda _: 1.0, wants_core=lambda _: True)
    silent = Watchdog("learner-0", LIMIT, cpu_of=lambda _: 1.0, wants_core=lambda _: False)
    processes, heard = [("learner-0", 1, 0.0)], {"learner-0": 10.0}
    times = [10.0 + second for second in range(int(2 * LIMIT))]

    assert [starved.look(processes, heard, now) for now in times] == [[]] * len(times)
    assert [silent.look(processes, heard, now) for now in times][-1] == ["learner-0"]


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="needs /proc")
def test_a_stopped_process_is_told_from_a_busy_one():
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    stopped = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        time.sleep(0.3)
        stopped.send_signal(signal.SIGSTOP)
        time.sleep(0.1)
        watchdog = Watchdog("learner-0", 7.0)
        processes = [("learner-0", os.getpid(), 0.0), ("busy", busy.pid, 0.0), ("stopped", stopped.pid, 0.0)]
        heard = {"learner-0": 11.0}
        watchdog.look(processes, heard, 6.0)
        begin, deadline = cpu_seconds(busy.pid), time.monotonic() + 30.0
        while (
            cpu_seconds(busy.pid) - begin < 0.5 and time.monotonic() < deadline
        ):  # the watchdog's clock says 5.5 s
            time.sleep(0.05)
        found = watchdog.look(processes, heard, 6.0 + LOOK_S + 0.5)
        wanting = wants_a_core(busy.pid), wants_a_core(stopped.pid)
    finally:
        for process in (busy, stopped):
            process.kill()
            process.wait()

    assert found == ["stopped"]
    assert wanting == (True, False)
    assert cpu_seconds(2**30) is None


def test_the_work_of_a_process_is_that_of_its_children_too():
    burns = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'while True: pass'], check=False)"
    process = subprocess.Popen([sys.executable, "-c", burns], start_new_session=True)
    try:
        wait_until(lambda: (cpu_seconds(process.pid) or 0.0) > 0.5, 30, "the child's work to count")
        assert wants_a_core(process.pid)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
