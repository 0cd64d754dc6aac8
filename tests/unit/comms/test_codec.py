import contextlib
import dataclasses
import math
import struct
import zlib
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.fuzz.message_examples import EXAMPLES, make_rollout, make_stage, make_verdict
from common.comms.budgets import one_line
from common.comms.codec import DecodeError, EncodeError, decode, encode, salvage
from common.comms.messages import (
    MESSAGES,
    Rollout,
    StageLog,
    Verdict,
    VerdictKind,
)
from common.comms.wire import slots_of

JSONISH = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


AS_FLOAT16 = ("obs", "final_obs", "last_obs", "corrections")  # 11 significant bits


def sealed(body: bytes) -> bytes:
    return struct.pack("<4sII", b"TSPN", zlib.crc32(body), len(body)) + body


def with_field(message: Any, field: str, raw: Any) -> bytes:
    """Return the bytes of ``message`` with ``raw`` in the place of one field, without the codec's checks."""
    kind, version, fields = msgpack.unpackb(encode(message)[12:])
    fields[field] = raw
    return sealed(msgpack.packb([kind, version, fields]))


def assert_same(got: Any, wanted: Any) -> None:
    for field in dataclasses.fields(wanted):
        one, other = getattr(got, field.name), getattr(wanted, field.name)
        if dataclasses.is_dataclass(other):
            assert_same(one, other)
        elif isinstance(other, np.ndarray):
            as_float16 = type(wanted) is Rollout and field.name in AS_FLOAT16
            np.testing.assert_allclose(one, other, rtol=2**-11 if as_float16 else 0.0, atol=0.0)
            assert one.dtype == other.dtype
        else:
            assert one == other


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_a_decoded_message_equals_what_was_encoded(message):
    assert_same(decode(encode(message), type(message)), message)


def test_every_number_declares_its_unit_and_every_array_its_dtype_and_dims():
    slots = [slot for kind in MESSAGES for slot in slots_of(kind)]

    for slot in slots:
        is_array = getattr(slot.kind, "__origin__", None) is np.ndarray
        assert bool(slot.wire.dtype) == bool(slot.wire.dims) == is_array, slot
        assert slot.kind not in (int, float) or slot.wire.unit, slot


def test_decoded_arrays_are_read_only():
    rollout = decode(encode(make_rollout()), Rollout)

    with pytest.raises(ValueError, match="read-only"):
        rollout.obs[0, 0, 0] = 1.0
    with pytest.raises(TypeError):
        rollout.seconds["step"] = 1.0  # type: ignore[index]


def test_arrays_that_are_views_travel_by_their_values():
    wide = np.asfortranarray(np.random.default_rng(0).normal(size=(3, 2, 7)).astype("<f4"))

    rollout = decode(encode(make_rollout(obs=wide[..., :5], actions=wide)), Rollout)

    np.testing.assert_array_equal(rollout.actions, wide)
    np.testing.assert_array_equal(rollout.obs, wide[..., :5].astype(np.float16))


def test_observations_arrive_as_float32_and_too_large_ones_are_refused():
    obs = np.full((3, 2, 5), 1e4, np.float32)  # more than the learner takes
    obs[0, 0] = -3.14159, 1.00048828125, 6e-5, 0.0, 65504.0

    got = decode(encode(make_rollout(obs=obs)), Rollout).obs

    assert got.dtype == np.float32
    np.testing.assert_allclose(got[0, 0], [-3.140625, 1.0, 6e-5, 0.0, 65504.0], rtol=1e-3, atol=0.0)
    assert got[0, 0, :2].tolist() == [-3.140625, 1.0]
    assert (got[1:] == 1e4).all()
    obs[2, 1, 4] = 1e5
    with pytest.raises(DecodeError, match=r"Rollout.obs\[2, 1, 4\]: inf; allowed"):
        decode(encode(make_rollout(obs=obs)), Rollout)


def test_a_rollout_without_episodes_or_truncations_is_fine():
    rollout = make_rollout(
        truncated=np.zeros((3, 2), bool), final_obs=np.zeros((0, 5), "<f4"), final_index=np.zeros(0, "<i4")
    )

    assert decode(encode(rollout), Rollout).final_obs.shape == (0, 5)


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b"", "0 bytes are too few for a header"),
        (b"GET / HTTP/1.1\r\n\r\n", "starts with b'GET '.*not a Topspin message"),
        (encode(make_verdict())[:-1], "cut or joined"),
        (encode(make_verdict()) + b"x", "cut or joined"),
        (encode(make_verdict())[:-1] + b"\xff", "corrupt: checksum"),
        (sealed(b"\xc1"), "the body is not msgpack"),
        (sealed(b"\x91" * 3000), "the body is not msgpack"),
        (sealed(msgpack.packb([1, 2])), r"not \[type, version, fields\]"),
        (sealed(msgpack.packb(["Spam", 1, {}])), "got a message of type 'Spam'; allowed here: Verdict"),
        (
            sealed(msgpack.packb(["Verdict", 2, {}])),
            "Verdict: version 2; allowed: 1: run the same release everywhere",
        ),
        (sealed(msgpack.packb(["Verdict", True, {}])), "version True"),
        (sealed(msgpack.packb(["Verdict", 1, {"kind": "busy", "spam": 1}])), "missing.*first.*unknown.*spam"),
        (with_field(make_verdict(), "kind", "maybe"), "Verdict.kind: 'maybe'; allowed: accepted, "),
        (
            with_field(make_verdict(), "credit_limit", "2"),
            "credit_limit: '2' of type str; allowed: int",
        ),
        (with_field(make_verdict(), "credit_limit", -1), "Verdict.credit_limit: -1; allowed: 0 to"),
        (with_field(make_verdict(), "stage", 4), "Verdict.stage: 4; allowed: 1 to 3"),
        (with_field(make_verdict(), "reason", msgpack.ExtType(1, b"x")), "extension type 1"),
    ],
)
def test_a_bad_message_is_refused_with_one_clear_line(payload, message):
    with pytest.raises(DecodeError, match=message) as caught:
        decode(payload, Verdict)

    assert "\n" not in str(caught.value)


def raw_array(array: Any) -> list[Any]:
    return [array.dtype.str, list(array.shape), array.tobytes()]


BAD_OBS = np.zeros((3, 2, 5), "<f2")
BAD_OBS[2, 1, 4] = np.nan
BAD_OBS[2, 1, 3] = np.inf


@pytest.mark.parametrize(
    ("field", "raw", "message"),
    [
        ("obs", raw_array(BAD_OBS), r"Rollout.obs\[2, 1, 3\]: inf; allowed: .*finite \(2 such values\)"),
        ("obs", raw_array(np.zeros((3, 2, 5), "<f4")), "Rollout.obs: dtype '<f4'; allowed: '<f2'"),
        ("log_mu", raw_array(np.zeros((3, 2))), "Rollout.log_mu: dtype '<f8'; allowed: '<f4'"),
        ("obs", raw_array(np.zeros((3, 2), "<f2")), r"Rollout.obs: shape \(3, 2\); allowed: \[T, B, D\]"),
        ("actions", raw_array(np.zeros((3, 2, 6), "<f4")), r"Rollout.actions: .*allowed: \[T, B, 7\]"),
        ("rewards", raw_array(np.zeros((3, 4), "<f4")), r"Rollout.rewards: .*with B = 2 as in Rollout.obs"),
        ("rewards", ["<f4", [3, 2], b"123"], r"Rollout.rewards: 3 bytes; allowed: 24 bytes"),
        ("rewards", ["<f4", [3, -2], b""], r"Rollout.rewards: shape \[3, -2\]"),
        ("rewards", ["<f4", [2**62, 2**62], b""], r"Rollout.rewards: shape"),
        ("rewards", 7, "Rollout.rewards: 7; allowed: an array"),
        ("terminated", ["|b1", [3, 2], b"\0\0\0\0\0\2"], r"Rollout.terminated\[2, 1\]: 2; allowed: 0 to 1"),
        ("final_index", raw_array(np.array([-5], "<i4")), r"Rollout.final_index\[0\]: -5; allowed: 0 to inf"),
        ("final_index", raw_array(np.array([5], "<i4")), "1 final_index do not name the 1 truncated steps"),
        ("terminated", raw_array(np.ones((3, 2), bool)), "both terminated and truncated"),
        ("seconds", {"step": math.nan}, r"Rollout.seconds\['step'\]: nan"),
        ("seconds", {"step": "1"}, r"Rollout.seconds\['step'\]: '1' of type str"),
        ("sequence", 2**60, "Rollout.sequence: 1152921504606846976; allowed: 0 to 9.0072e\\+15"),
        ("episodes", 3, "Rollout.episodes: 3 of type int; allowed: dict"),
    ],
)
def test_a_bad_rollout_names_the_field_what_was_got_and_what_is_allowed(field, raw, message):
    with pytest.raises(DecodeError, match=message):
        decode(with_field(make_rollout(), field, raw), Rollout)


def test_an_oversize_message_is_refused_before_it_is_read():
    with pytest.raises(DecodeError, match="101 bytes; allowed: up to 100"):
        decode(b"x" * 101, Verdict, limit_bytes=100)


def test_a_field_with_a_default_may_be_missing_so_that_older_senders_are_understood():
    kind, version, fields = msgpack.unpackb(encode(make_rollout())[12:])
    del fields["seconds"]

    rollout = decode(sealed(msgpack.packb([kind, version, fields])), Rollout)

    assert rollout.seconds == {}


def test_a_nested_message_is_checked_like_any_other():
    with pytest.raises(DecodeError, match=r"StageLog.changes\[0\]: missing fields \['run'"):
        decode(with_field(StageLog(()), "changes", [{}]), StageLog)
    with pytest.raises(DecodeError, match=r"stage numbers \[1, 1\]; allowed: increasing"):
        decode(encode(StageLog((make_stage(1), make_stage(1)))), StageLog)


def test_the_sequence_numbers_of_an_actor_last_for_a_century():
    a_century = 100 * 366 * 86_400 * 1000  # at a thousand a second

    assert decode(encode(make_rollout(sequence=a_century)), Rollout).sequence == a_century


def test_the_sender_of_a_bad_rollout_can_still_be_read():
    payload = with_field(make_rollout(), "obs", raw_array(BAD_OBS))

    assert salvage(payload, Rollout, ("actor", "sequence")) == {"actor": "actor-0", "sequence": 11}
    assert salvage(payload[:-1], Rollout, ("actor", "sequence")) == {}


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (make_rollout(obs=np.zeros((3, 2, 5))), "Rollout.obs: float64; allowed: array of float32"),
        (make_rollout(rewards=np.zeros((2, 2), "<f4")), "Rollout.rewards: shape .*T = 3 as in Rollout.obs"),
        (make_verdict(reason=3), "Verdict.reason: int; allowed: str"),
        (make_verdict(kind="accepted"), "Verdict.kind: str; allowed: VerdictKind"),
        (make_verdict(credit_limit=2**70), "Verdict"),
    ],
)
def test_a_message_that_differs_from_its_declaration_is_not_encoded(message, error):
    with pytest.raises(EncodeError, match=error):
        encode(message)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200) | st.binary(max_size=200).map(sealed))
def test_no_bytes_raise_anything_but_a_decode_error(payload):
    for kind in MESSAGES:
        with pytest.raises(DecodeError):
            decode(payload, kind)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(EXAMPLES),
    st.lists(st.tuples(st.integers(0, 2**31), st.integers(0, 255)), min_size=1, max_size=4),
    st.booleans(),
)
def test_flipped_bytes_raise_nothing_but_a_decode_error(message, flips, reseal):
    payload = bytearray(encode(message))
    for position, value in flips:
        payload[12 + position % (len(payload) - 12)] = value
    damaged = sealed(bytes(payload[12:])) if reseal else bytes(payload)

    try:
        decode(damaged, type(message))
    except DecodeError:
        return
    # only bytes with a new checksum, or unchanged bytes, may pass
    assert reseal or damaged == encode(message)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(EXAMPLES), st.integers(0, 30), JSONISH)
def test_any_content_of_a_field_raises_nothing_but_a_decode_error(message, index, raw):
    names = [slot.name for slot in slots_of(type(message))]

    with contextlib.suppress(DecodeError):
        decode(with_field(message, names[index % len(names)], raw), type(message))


@given(st.integers(0, 2**62), st.sampled_from(VerdictKind), st.text(max_size=50))
def test_any_valid_verdict_survives_the_wire(number, kind, reason):
    verdict = make_verdict(kind=kind, reason=one_line(reason), generation=number)

    assert decode(encode(verdict), Verdict) == verdict
