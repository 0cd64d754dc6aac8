"""Rallies drawn where they are played."""

import numpy as np
import pytest

from common.env.local_rallies import BLOCK, LocalRallies
from common.rally.launch import draw_rallies


def test_rallies_are_a_function_of_the_arguments_however_they_are_taken():
    at_once = LocalRallies(7).take(2 * BLOCK + 10)
    source = LocalRallies(7)
    parts = [source.take(count) for count in (1, BLOCK, 3, BLOCK + 6)]

    np.testing.assert_array_equal(np.concatenate([part.records for part in parts]), at_once.records)
    np.testing.assert_array_equal(np.concatenate([part.seeds for part in parts]), at_once.seeds)


def test_no_rally_comes_twice():
    assert len(set(LocalRallies(1).take(3 * BLOCK).seeds.tolist())) == 3 * BLOCK


def test_they_are_the_generators_and_valid():
    launches, block = (
        LocalRallies(5, "match", "hard").take(20),
        draw_rallies(20, seed=5, preset="match", noise="hard"),
    )

    np.testing.assert_array_equal(launches.records, block.launches)
    assert launches.validated.all()


def test_an_unknown_preset_is_refused():
    with pytest.raises(KeyError, match="papre"):
        LocalRallies(1, "papre").take(1)
