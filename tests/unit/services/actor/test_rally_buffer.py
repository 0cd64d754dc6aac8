import numpy as np
import pytest

from common.comms.messages import RallyBatch
from common.task.config import TaskConfig
from common.task.launch import LAUNCH_SIZE, Purpose, draw_rallies
from common.task.launch_presets import PRESETS
from services.actor.rally_buffer import RallyBuffer, launch_fault

OFF = TaskConfig(randomization="off")


def make_batch(sequence=0, count=4, first=0, **changes):
    """Return a batch whose rallies are numbered by their seeds."""
    rallies = np.zeros((count, LAUNCH_SIZE))
    rallies[:, 0] = np.arange(first, first + count) / 1000
    values = {
        "source": "generator-0",
        "incarnation": 1,
        "sequence": sequence,
        "shard": 0,
        "block": sequence,
        "rallies": rallies,
        "seeds": np.arange(first, first + count, dtype=np.uint64),
        "candidates": count,
        "launch": "paper",
        "randomization": "off",
    }
    return RallyBatch(**(values | changes))


def make_buffer(capacity=8, refill=lambda: None):
    return RallyBuffer(capacity, OFF, seed=3, refill=refill)


def test_each_rally_is_taken_once_in_the_order_of_arrival():
    buffer = make_buffer()
    buffer.put(make_batch(0, count=4, first=0))
    buffer.put(make_batch(1, count=4, first=4))

    taken = [buffer.take(np.arange(3)) for _ in range(2)] + [buffer.take(np.arange(2))]

    np.testing.assert_array_equal(np.concatenate([t.seeds for t in taken]), np.arange(8))
    np.testing.assert_allclose(np.concatenate([t.launches[:, 0] for t in taken]), np.arange(8) / 1000)
    assert all(t.validated.all() for t in taken)
    assert (buffer.counts.consumed, buffer.counts.underruns, len(buffer)) == (8, 0, 0)


def test_when_empty_launches_are_random_flagged_counted_and_never_a_generators():
    buffer = make_buffer()
    buffer.put(make_batch(count=2))

    taken = buffer.take(np.arange(5))
    more = buffer.take(np.arange(3))

    assert taken.validated.tolist() == [True, True, False, False, False]
    assert not more.validated.any()
    assert (buffer.counts.consumed, buffer.counts.underruns) == (2, 6)
    drawn = np.concatenate((taken.seeds[2:], more.seeds))
    assert len(set(drawn.tolist())) == 6
    assert set((drawn >> np.uint64(62)).tolist()) == {int(Purpose.FALLBACK)}
    np.testing.assert_array_equal(
        taken.launches[2:], draw_rallies(3, OFF, seed=3, purpose=Purpose.FALLBACK).launches
    )


def test_it_is_refilled_until_there_is_enough_or_nothing_more_arrives():
    waiting = [make_batch(i, count=2, first=2 * i) for i in range(4)]
    buffer = make_buffer(refill=lambda: buffer.put(waiting.pop(0)) if waiting else None)

    assert buffer.take(np.arange(5)).validated.all()
    assert len(waiting) == 1
    assert buffer.take(np.arange(4)).validated.sum() == 3


@pytest.mark.parametrize("size", [3, 8, 50])
def test_batches_of_any_size_fill_the_stock_without_losing_a_rally(size):
    buffer, sequence = make_buffer(capacity=8), 0
    seen = []
    for _ in range(30):
        while buffer.room > 0:
            buffer.put(make_batch(sequence, count=size, first=size * sequence))
            sequence += 1
        seen.extend(buffer.take(np.arange(5)).seeds.tolist())

    assert seen == list(range(150))
    assert (buffer.counts.overflowed, buffer.counts.underruns, buffer.counts.gaps) == (0, 0, 0)


def test_arrivals_while_it_is_full_push_the_oldest_out_and_are_counted():
    buffer = make_buffer(capacity=4)
    for sequence in range(3):
        buffer.put(make_batch(sequence, count=4, first=4 * sequence))

    # it holds up to a batch more than its capacity
    assert buffer.counts.overflowed == 5
    assert buffer.take(np.arange(7) % 4).seeds.tolist() == list(range(5, 12))
    assert buffer.counts.received == buffer.counts.overflowed + buffer.counts.consumed


def test_gaps_and_repeats_are_counted_by_source():
    buffer = make_buffer(capacity=100)
    for sequence in (0, 1, 4, 4, 2):
        buffer.put(make_batch(sequence, count=1))
    buffer.put(make_batch(7, count=1, source="generator-1"))  # the first of another stream
    buffer.put(make_batch(0, count=1, incarnation=2))

    assert (buffer.counts.gaps, buffer.counts.repeated, buffer.counts.received) == (2, 2, 5)


@pytest.mark.parametrize("preset", PRESETS)
def test_generators_launches_pass_and_impossible_ones_do_not(preset):
    block = draw_rallies(200, TaskConfig(launch=preset, randomization="hard"), seed=1)
    batch = make_batch(count=200, rallies=block.launches, seeds=block.seeds)
    wild = block.launches.copy()
    wild[17, 4] = 1e9

    assert launch_fault(batch, preset) == ""
    assert launch_fault(make_batch(count=200, rallies=wild, seeds=block.seeds), preset) == (
        "velocity 1e+09; allowed: -60 to 60"
    )


@pytest.mark.parametrize(
    ("preset", "kind", "allowed"),
    [
        ("paper", 2.0, "0"),
        ("mixed", 4.0, "0, 1"),
        ("all", 5.0, "0, 1, 2, 3, 4"),
        ("all", 0.5, "0, 1, 2, 3, 4"),
    ],
)
def test_kinds_that_the_preset_does_not_have_are_refused(preset, kind, allowed):
    """No ring would be asked for them, and an actor that has no others would find nothing to play."""
    block = draw_rallies(20, TaskConfig(launch=preset), seed=1)
    block.launches[3, 11] = kind

    assert launch_fault(make_batch(count=20, rallies=block.launches, seeds=block.seeds), preset) == (
        f"kind {kind:g}; allowed in {preset}: {allowed}"
    )


def test_a_forged_number_does_not_hide_the_batches_that_follow():
    buffer = make_buffer(capacity=64)
    for sequence in (0, 2**62, 1, 2):
        buffer.put(make_batch(sequence, count=2, first=2 * (sequence % 1000)))

    assert buffer.counts.received == 8
    assert buffer.counts.repeated == 0
    assert buffer.counts.gaps <= 4096
