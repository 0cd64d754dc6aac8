import math

import numpy as np
import pytest

from common.physics.exponential import erfc, exp


@pytest.mark.parametrize("x", [*np.linspace(-699.0, 699.0, 400), -1e-9, 0.0, 1e-9])
def test_exp_has_8_digits(x):
    assert exp(x) == pytest.approx(math.exp(x), rel=1e-8)


def test_exp_of_very_little_is_next_to_nothing_and_of_nan_nan():
    assert 0.0 <= exp(-1e300) < 1e-300
    assert 0.0 <= exp(-math.inf) < 1e-300


@pytest.mark.parametrize("x", np.linspace(-6.0, 6.0, 241))
def test_erfc_has_6_digits(x):
    assert erfc(x) == pytest.approx(math.erfc(x), rel=2e-7)
