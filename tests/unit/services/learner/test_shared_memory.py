"""Links over shared memory, with a thread for each rank."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from services.learner.group import Group, GroupError
from services.learner.shared_memory import MAILBOX, READ_BY_ALL, ROOM, SharedMemoryLinks


def together(size, folder, act, timeout_s=20.0):
    """Return what ``act`` returns for the links of each rank."""

    def run(rank):
        links = SharedMemoryLinks(rank, size, folder / "group", timeout_s)
        try:
            return act(rank, links)
        finally:
            links.close()

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(run, range(size)))


@pytest.mark.parametrize("size", [2, 3, 5])
def test_every_rank_gets_the_bytes_of_all_in_the_order_of_ranks(size, tmp_path):
    """Rank 1's go in three pieces, and rank 0 has none."""
    lengths = [0, 2 * ROOM + 7, ROOM, 1, ROOM + 1][:size]
    texts = [np.random.default_rng(rank).bytes(length) for rank, length in enumerate(lengths)]
    found = together(size, tmp_path, lambda rank, links: [links.exchanged(texts[rank]) for _ in range(3)])

    assert all(turn == texts for turns in found for turn in turns)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [2, 3, 5])
def test_sums_are_those_of_the_ranks_one_after_the_other_bit_for_bit(size, dtype, tmp_path):
    """Of 400,000 numbers a part goes in shares, and all of them in several pieces."""
    rng = np.random.default_rng(0)
    for count in (1, 3, 1000, 400_000):
        parts = rng.standard_normal((size, count)).astype(dtype)
        assert count < 400_000 or parts.nbytes > max(READ_BY_ALL, MAILBOX)
        expected = parts[0].copy()
        for part in parts[1:]:
            expected += part
        own = [part.copy() for part in parts]
        together(size, tmp_path, lambda rank, links, own=own: links.add(own[rank]))

        for values in own:
            np.testing.assert_array_equal(values, expected)


def test_turns_follow_each_other_though_one_rank_is_always_late(tmp_path):
    def act(rank, links):
        sums = []
        for turn in range(50):
            if rank == turn % 3:
                time.sleep(0.002)
            values = np.full(1000, float(turn + rank))
            links.add(values)
            sums.append(set(values.tolist()))
        return sums

    for sums in together(3, tmp_path, act):
        assert sums == [{3.0 * turn + 3.0} for turn in range(50)]


def test_a_rank_that_waits_does_other_work_meanwhile(tmp_path):
    def act(rank, links):
        ticks = []
        if rank == 1:
            time.sleep(0.1)
        links.exchanged(b"", lambda: ticks.append(time.sleep(0.001)))
        return len(ticks)

    waited, _ = together(2, tmp_path, act)

    assert waited > 5


def test_a_rank_that_ends_is_noticed_at_once(tmp_path):
    def act(rank, links):
        if rank == 1:
            return ""
        started = time.monotonic()
        with pytest.raises(GroupError) as error:
            Group(rank, 2, links).add(np.ones(3))
        assert time.monotonic() - started < 5.0
        return str(error.value)

    said, _ = together(2, tmp_path, act)

    assert said.startswith("rank 0 of 2 learners lost another one: ")


@pytest.mark.parametrize("on_tick", [None, lambda: time.sleep(0.001)], ids=["idle", "busy"])
def test_a_rank_that_is_silent_is_lost_after_a_while(tmp_path, on_tick):
    def act(rank, links):
        if rank == 1:
            time.sleep(0.5)
            return
        with pytest.raises(TimeoutError):
            links.exchanged(b"", on_tick)

    together(2, tmp_path, act, timeout_s=0.1)


def test_ranks_that_do_not_come_are_named(tmp_path):
    with pytest.raises(TimeoutError, match="group-0"):
        SharedMemoryLinks(1, 2, tmp_path / "group", 0.1)
    with pytest.raises(TimeoutError):
        SharedMemoryLinks(0, 2, tmp_path / "group", 0.1)


def test_nothing_stays_in_the_folder(tmp_path):
    together(3, tmp_path, lambda rank, links: links.exchanged(b"x"))

    assert not list(tmp_path.iterdir())
