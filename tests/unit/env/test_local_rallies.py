"""Valid rallies drawn in the process that plays them."""

import numpy as np
import pytest
from pydantic import ValidationError

from common.env.local_rallies import BLOCK, LocalRallies
from common.task.config import TaskConfig
from common.task.launch import draw_rallies


def test_rallies_are_the_same_in_whatever_portions_they_are_taken():
    at_once = LocalRallies(7).take(np.arange(2 * BLOCK + 10))
    source = LocalRallies(7)
    parts = [source.take(np.arange(count)) for count in (1, BLOCK, 3, BLOCK + 6)]

    np.testing.assert_array_equal(np.concatenate([part.launches for part in parts]), at_once.launches)
    np.testing.assert_array_equal(np.concatenate([part.seeds for part in parts]), at_once.seeds)


def test_no_rally_comes_twice():
    assert len(set(LocalRallies(1).take(np.arange(3 * BLOCK)).seeds.tolist())) == 3 * BLOCK


def test_local_rallies_are_the_generators_and_are_validated():
    task = TaskConfig(launch="match", randomization="hard")
    rallies, block = LocalRallies(5, task).take(np.arange(20)), draw_rallies(20, task, seed=5)

    np.testing.assert_array_equal(rallies.launches, block.launches)
    assert rallies.validated.all()


def test_an_unknown_preset_is_refused():
    with pytest.raises(ValidationError, match="launch"):
        LocalRallies(1, TaskConfig.model_validate({"launch": "papre"})).take(1)
