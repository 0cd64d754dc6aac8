"""What the robustness benchmark varies."""

from typing import get_args

from benchmarks.robustness import TOLD
from common.task.config import PresetName
from common.task.observation import ExpectedSpin


def test_every_preset_has_a_spin_that_it_can_be_told():
    assert set(TOLD) == set(get_args(PresetName))
    assert set(TOLD.values()) <= set(get_args(ExpectedSpin)) - {"learnt"}
