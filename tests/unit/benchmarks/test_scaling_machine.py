"""Virtual time: processes share the cores as a slow reference shares them in small steps of time."""

import numpy as np
import pytest

from benchmarks.scaling.machine import Machine, Wait, Work

TICK = 0.001  # [s] of the reference


def ends(jobs, cores, slowdown=1.0):
    """Return when each job of (arrival, work) [s] ends on the machine."""
    machine, found = Machine(cores, slowdown), {}

    def job(number, arrival, work):
        yield Wait(arrival)
        yield Work(work)
        found[number] = machine.now

    for number, (arrival, work) in enumerate(jobs):
        machine.start(job(number, arrival, work))
    machine.run(lambda: len(found) == len(jobs))
    return [found[number] for number in range(len(jobs))]


def slow_ends(jobs, cores):
    """Return the same, in small steps: in each, every job that is there gets its share of the cores."""
    left, found, now = [work for _, work in jobs], [0.0] * len(jobs), 0.0
    while any(work > 0 for work in left):
        there = [k for k, (arrival, _) in enumerate(jobs) if arrival <= now and left[k] > 0]
        for k in there:
            left[k] -= TICK * min(1.0, cores / len(there))
            if left[k] <= 0:
                found[k] = now + TICK
        now += TICK
    return found


@pytest.mark.parametrize(("seed", "cores"), [(0, 1.0), (1, 2.0), (2, 2.7), (3, 20.0)])
def test_processes_share_the_cores_equally(seed, cores):
    rng = np.random.default_rng(seed)
    jobs = list(zip(rng.uniform(0, 2, 12).tolist(), rng.uniform(0.05, 0.6, 12).tolist(), strict=True))

    # each arrival and each end is up to a tick late in the reference, and that delays the others
    np.testing.assert_allclose(ends(jobs, cores), slow_ends(jobs, cores), atol=12 * TICK)


def test_three_equal_jobs_on_two_cores_take_one_and_a_half_times_as_long():
    assert ends([(0.0, 1.0)] * 3, 2.0) == pytest.approx([1.5, 1.5, 1.5])


def test_a_job_that_comes_later_slows_the_first_from_then_on():
    assert ends([(0.0, 1.0), (0.5, 1.0)], 1.0) == pytest.approx([1.5, 2.0])


@pytest.mark.parametrize(("jobs", "expected"), [(1, 1.0), (2, 1.1), (4, 1.3), (8, 2.6)])
def test_work_takes_longer_the_more_cores_are_busy(jobs, expected):
    """1.3 times as long with four busy cores of four, linearly from 1 with one; eight jobs have half a core each."""
    assert ends([(0.0, 1.0)] * jobs, 4.0, slowdown=1.3) == pytest.approx([expected] * jobs)


def test_a_wake_counts_for_a_process_that_waits_only():
    machine, seen = Machine(1.0), []

    def sleeper():
        yield Work(1.0)
        seen.append(machine.now)
        yield Wait()
        seen.append(machine.now)

    process = machine.start(sleeper())
    for time in (0.5, 3.0):
        machine.at(time, lambda: machine.wake(process))
    machine.run(lambda: len(seen) == 2)

    assert seen == [1.0, 3.0]


def test_an_old_alarm_wakes_nobody():
    machine, seen = Machine(1.0), []

    def sleeper():
        yield Wait(2.0)
        yield Wait(5.0)
        seen.append(machine.now)

    process = machine.start(sleeper())
    machine.at(1.0, lambda: machine.wake(process))
    machine.run(lambda: bool(seen))

    assert seen == [5.0]


def test_the_time_with_work_counts_while_a_core_is_shared():
    machine = Machine(1.0)

    def worker(seconds):
        yield Work(seconds)
        yield Wait(10.0)

    one, other = machine.start(worker(1.0)), machine.start(worker(2.0))
    machine.run(lambda: machine.now >= 2.0)

    assert (one.busy(2.0), other.busy(2.5)) == (2.0, 2.5)


def test_processes_that_all_wait_are_an_error():
    machine = Machine(1.0)

    def sleeper():
        yield Wait()

    machine.start(sleeper())
    with pytest.raises(RuntimeError, match=r"^every process waits, and nothing will wake one$"):
        machine.run(lambda: False)


def test_a_machine_without_cores_is_refused():
    with pytest.raises(ValueError, match=r"^cores 0, slowdown 1.0; allowed: above 0, and from 1$"):
        Machine(0)
