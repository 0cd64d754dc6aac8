"""Every decoder and every file reader, with valid bytes that were changed: it reads them or refuses them.

The long form, with inputs that look for new lines of code, is `python -m benchmarks.fuzz`.
"""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz.targets import targets

INPUTS = 120  # of each target
PIECES = [b"nan", b"1e400", b"-1", b"9" * 5000, b"[" * 3000, b"{", b'"', b"\x00", b"\n", b"\xff"]


@st.composite
def changed(draw, examples):
    """Draw a valid input that is cut, doubled, overwritten or mixed with bytes."""
    data = bytearray(draw(st.sampled_from(examples)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        end = draw(st.integers(at, min(len(data), at + 64)))
        piece = draw(
            st.one_of(
                st.binary(max_size=16),
                st.sampled_from(PIECES),
                st.just(bytes(data[at:end]) * 2),
            )
        )
        data[at:end] = piece
    return bytes(data)


@pytest.mark.parametrize("name", targets())
def test_a_valid_example_is_read(name):
    target = targets()[name]

    assert all(target.run(example) or example == b"[]" for example in target.examples)


@pytest.mark.parametrize("name", targets())
def test_changed_bytes_are_read_or_refused(name):
    target = targets()[name]

    @settings(max_examples=INPUTS, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(changed(target.examples))
    def try_it(data):
        target.run(data)

    try_it()
