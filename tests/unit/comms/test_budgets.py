"""A message costs its receiver no more than its budget, whatever a peer puts into it."""

import dataclasses
import time
import tracemalloc

import msgpack
import pytest
from hypothesis import given

from benchmarks.fuzz.message_examples import EXAMPLES, make_rollout, make_verdict
from common.comms.budgets import BUDGETS, CONTROL, KIB, LONGEST_TEXT, items_in, one_line
from common.comms.codec import DecodeError, EncodeError, decode, encode
from common.comms.messages import MESSAGES, ActorReport, Refusal, Rollout, Verdict, VerdictKind
from services.learner.admission import open_rollout
from tests.unit.comms.test_codec import JSONISH, sealed, with_field

REPORT = next(example for example in EXAMPLES if isinstance(example, ActorReport))


def plain_count(value):
    if isinstance(value, list):
        return 1 + sum(map(plain_count, value))
    if isinstance(value, dict):
        return 1 + sum(plain_count(key) + plain_count(item) for key, item in value.items())
    return 1


def test_every_message_has_its_budget():
    assert set(BUDGETS) == {kind.__name__ for kind in MESSAGES}
    assert CONTROL.bytes == 64 * KIB


@given(JSONISH)
def test_items_are_counted_as_the_unpacker_builds_them(value):
    body = memoryview(msgpack.packb(value))
    count = plain_count(value)

    assert items_in(body, 10**6) == count
    assert items_in(body, count) == count
    assert items_in(body, count - 1) == count


@given(JSONISH)
def test_a_cut_body_is_counted_without_an_error(value):
    body = msgpack.packb(value)

    for end in range(len(body)):
        items_in(memoryview(body)[:end], 100)


@pytest.mark.parametrize("content", [b"\x80" * 65_535, b"\x90" * 65_535], ids=["maps", "arrays"])
def test_megabytes_of_empty_containers_are_refused_before_they_are_built(content):
    """They took 870 MB and 3.7 s."""
    inner = b"\xdc\xff\xff" + content
    body = b"\x93\xa7Rollout\x04\x81\xa3obs\xdc\x00\x60" + inner * 96
    payload = sealed(body)
    tracemalloc.start()
    started = time.perf_counter()
    opened = open_rollout(payload, 2**26, 37)
    took = time.perf_counter() - started
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert len(payload) > 6_000_000
    assert opened is None
    assert took < 1.0
    assert peak < 2**20
    with pytest.raises(DecodeError, match="more than 4096 items; allowed: up to 4096"):
        decode(payload, Rollout)


def test_a_control_message_over_64_kib_is_refused_unread():
    refusals = tuple(Refusal(n, VerdictKind.TOO_OLD, 0) for n in range(65_000))

    with pytest.raises(DecodeError, match=r"ActorReport: \d+ bytes; allowed: up to 65536"):
        decode(encode(dataclasses.replace(REPORT, refused=refusals)), ActorReport)


@pytest.mark.parametrize(
    ("field", "raw", "message"),
    [
        ("dropped", [-1], r"ActorReport\.dropped\[0\]: -1; allowed: 0 to"),
        ("in_flight", [2**60], r"ActorReport\.in_flight\[0\]: 1152921504606846976; allowed: 0 to"),
        ("in_flight", [1.5], r"ActorReport\.in_flight\[0\]: 1.5 of type float; allowed: int"),
        ("dropped", list(range(257)), r"257 dropped; allowed: up to 256"),
    ],
)
def test_the_numbers_in_a_report_are_bounded(field, raw, message):
    with pytest.raises(DecodeError, match=message):
        decode(with_field(REPORT, field, raw), ActorReport)


@pytest.mark.parametrize(
    "name",
    ["", "a" * 65, "a/b", "a\nb", "a\x1b[2J", "-a", "a" * 15_000_000],
    ids=lambda name: repr(name)[:12],
)
def test_an_id_that_could_not_stand_in_a_key_is_refused(name):
    with pytest.raises(DecodeError, match=r"Rollout\.actor: .*; allowed: ") as caught:
        decode(with_field(make_rollout(), "actor", name), Rollout)

    assert len(str(caught.value)) < 300
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", ["two\nlines", "\x1b[31mred", "x" * (LONGEST_TEXT + 1), "\u202eleft"])
def test_text_that_a_terminal_interprets_is_neither_sent_nor_read(text):
    with pytest.raises(EncodeError, match=r"Verdict\.reason"):
        encode(make_verdict(reason=text))
    with pytest.raises(DecodeError, match=r"Verdict\.reason") as caught:
        decode(with_field(make_verdict(), "reason", text), Verdict)
    assert str(caught.value).isprintable()

    assert decode(encode(make_verdict(reason=one_line(text))), Verdict).reason == one_line(text)


def test_one_line_keeps_what_is_printable():
    assert one_line("a\nb\x1b[2J é") == "a\\nb\\x1b[2J é"
    assert len(one_line("x" * 10**6)) == LONGEST_TEXT
