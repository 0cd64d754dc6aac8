import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.policy.normalizer import Moments, normalize


@given(cuts=st.lists(st.integers(1, 299), max_size=6), offset=st.floats(-1e3, 1e3), seed=st.integers(0, 1000))
def test_moments_merged_from_parts_equal_those_of_all_data_at_once(cuts, offset, seed):
    data = offset + np.random.default_rng(seed).normal(size=(300, 3)) * [0.1, 1.0, 20.0]
    parts = [part for part in np.split(data, sorted(set(cuts))) if len(part)]

    merged = Moments.of(parts[0])
    for part in parts[1:]:
        merged = merged.merged(Moments.of(part))

    assert merged.count == 300
    np.testing.assert_allclose(merged.mean, data.mean(axis=0), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(merged.var, data.var(axis=0), rtol=1e-9)


@pytest.mark.parametrize("step", [1, 2])
def test_moments_of_float32_are_those_of_the_same_numbers_in_float64(step):
    """Far from zero, where the squares of float32 would lose the variance."""
    data = np.random.default_rng(0).normal(1000.0, 0.5, size=(999, 11)).astype(np.float32)[::step, ::step]
    moments, exact = Moments.of(data), data.astype(np.float64)

    assert moments.count == len(data)
    np.testing.assert_allclose(moments.mean, exact.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(moments.var, exact.var(axis=0), rtol=1e-11)


def test_merging_in_another_order_gives_the_same():
    rng = np.random.default_rng(0)
    a, b, c = (Moments.of(rng.normal(size=(n, 2))) for n in (3, 50, 700))

    one, other = a.merged(b).merged(c), c.merged(a).merged(b)

    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-12)
    np.testing.assert_allclose(one.var, other.var, rtol=1e-12)


def test_a_stage_change_resets_the_count_and_keeps_mean_and_variance():
    before = Moments.of(np.random.default_rng(0).normal(3.0, 2.0, size=(1000, 4)))

    after = before.recounted()

    assert after.count == 1
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_array_equal(after.var, before.var)
    # New data dominate at once, as they must when the rewards and so the states change.
    moved = after.merged(Moments.of(np.zeros((100, 4))))
    assert np.abs(moved.mean).max() < 0.05


def test_normalised_data_have_mean_0_variance_1_and_are_clipped_at_5():
    data = np.random.default_rng(0).normal(7.0, 3.0, size=(10_000, 2)).astype(np.float32)
    data[0] = 1000.0

    result = normalize(data, Moments.of(data[1:]))

    assert result.dtype == np.float32
    np.testing.assert_array_equal(result[0], 5.0)
    np.testing.assert_allclose(result[1:].mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(result[1:].std(axis=0), 1.0, atol=1e-2)


def test_a_constant_input_stays_finite():
    data = np.full((10, 1), 2.0, np.float32)

    assert np.isfinite(normalize(data + 0.01, Moments.of(data))).all()
