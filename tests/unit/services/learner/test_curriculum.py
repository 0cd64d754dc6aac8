import math

import pytest
from pydantic import ValidationError

from services.learner.config import CurriculumConfig
from services.learner.curriculum import StageLengths, Trained

CONFIG = CurriculumConfig(stage_1=300, stage_2=200, stage_3=1000)
SHARES = CurriculumConfig(stage_shares=(0.14, 0.48, 0.38))


def stages(config, epochs, frames=0, size=100, catch=math.nan):
    """Return the stage of each epoch, with datasets of ``size`` frames."""
    lengths, trained, seen = StageLengths(config, frames), Trained(config.first_stage, 0, 0, 0), []
    for epoch in range(1, epochs + 1):
        seen.append(trained.stage)
        trained = Trained(trained.stage, trained.began, epoch, epoch * size)
        following = lengths.next_stage(trained, catch)
        began = trained.began if following == trained.stage else trained.frames
        trained = Trained(following, began, epoch, epoch * size)
    return seen


def in_stage(stage, began=0, frames=100, epochs=1):
    return Trained(stage, began, epochs, frames)


def test_each_stage_lasts_its_frames():
    assert stages(CONFIG, 8) == [1, 1, 1, 2, 2, 3, 3, 3]


def test_a_stage_lasts_as_many_frames_with_datasets_of_another_size_and_ends_with_one():
    assert stages(CONFIG, 9, size=50) == [1] * 6 + [2] * 3
    assert stages(CONFIG, 6, size=160) == [1, 1, 2, 2, 3, 3]
    assert stages(CONFIG, 3, size=5000) == [1, 2, 3]


def test_a_stage_2_without_frames_is_left_out():
    assert stages(CONFIG.model_copy(update={"stage_2": 0}), 5) == [1, 1, 1, 3, 3]


@pytest.mark.parametrize("size", [1, 10, 20, 50])
def test_each_stage_lasts_its_share_of_the_frames_whatever_the_size_of_a_dataset(size):
    seen = stages(SHARES, 10_000 // size, frames=10_000, size=size)

    for stage, frames in ((1, 1400), (2, 4800), (3, 3800)):
        assert abs(seen.count(stage) * size - frames) < size  # a stage ends with a dataset


def test_stages_before_the_first_one_give_their_share_to_the_others():
    config = SHARES.model_copy(update={"first_stage": 2})

    assert StageLengths(config, 860).lengths() == (0, 480, 380)
    assert set(stages(SHARES.model_copy(update={"first_stage": 3}), 10, 1000)) == {3}


def test_a_share_of_0_leaves_stage_2_out():
    config = CurriculumConfig(stage_shares=(0.25, 0.0, 0.75))

    assert stages(config, 8, frames=800) == [1, 1, 3, 3, 3, 3, 3, 3]


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.5, 0.6, 0.1), (-0.1, 0.6, 0.5)])
def test_shares_that_are_not_three_parts_of_one_are_refused(shares):
    with pytest.raises(ValidationError, match="allowed: empty, or three numbers from 0 that sum to 1"):
        CurriculumConfig(stage_shares=shares)


def test_the_last_stage_needs_a_share():
    with pytest.raises(ValidationError, match=r"stage_shares with 0 for stage 3; allowed: above 0"):
        CurriculumConfig(stage_shares=(0.5, 0.5, 0.0))


def test_shares_need_a_number_of_frames():
    SHARES.check_budget(1000)
    CONFIG.check_budget(0)
    with pytest.raises(ValueError, match="stage_shares without frames; allowed: frames above 0"):
        SHARES.check_budget(0)


def test_frames_that_the_stages_dont_have_are_refused():
    curriculum = CurriculumConfig(stage_1=100, stage_2=100, stage_3=800)

    curriculum.check_budget(1000)
    with pytest.raises(
        ValueError, match=r"frames 1,001; allowed: up to 1,000, the sum of the stages: lengthen"
    ):
        curriculum.check_budget(1001)
    SHARES.check_budget(10**12)


def test_a_gate_ends_stage_1_early_once_enough_is_caught():
    lengths = StageLengths(CONFIG.model_copy(update={"catch_gate": 0.9}))

    assert lengths.next_stage(in_stage(1), 0.89) == 1
    assert lengths.next_stage(in_stage(1), 0.9) == 2
    assert lengths.next_stage(in_stage(1), math.nan) == 1


def test_the_curriculum_can_be_skipped():
    config = CONFIG.model_copy(update={"first_stage": 3})

    assert stages(config, 5) == [3] * 5
    assert config.frames == 1000


def test_the_datasets_that_a_stage_still_takes_are_counted_ahead():
    lengths, shared = StageLengths(CONFIG), StageLengths(SHARES, 1000)

    assert lengths.datasets_left(in_stage(1)) == 2
    assert lengths.datasets_left(in_stage(2, began=160, frames=200, epochs=2)) == 2  # to 360
    assert lengths.datasets_left(in_stage(3, began=300, frames=700, epochs=7)) == 8  # with what a gate saved
    assert (
        lengths.datasets_left(in_stage(1, frames=0, epochs=0)) == 1
    )  # the size of a dataset is not known yet
    assert shared.datasets_left(in_stage(1, frames=60, epochs=1)) == 2  # to 140
    assert shared.datasets_left(in_stage(3, began=620, frames=660, epochs=11)) == 6  # to 1000


def test_the_learning_rates_bound_falls_in_the_last_stage_only():
    lengths = StageLengths(CONFIG)

    def bound(stage, began, frames):
        return lengths.learning_rate_bound(in_stage(stage, began, frames), 1e-3, 1e-4)

    assert bound(1, 0, 200) == 1e-3
    assert bound(2, 300, 400) == 1e-3
    assert bound(3, 500, 500) == 1e-3
    assert bound(3, 500, 1000) == pytest.approx(5.5e-4)
    assert bound(3, 500, 9999) == pytest.approx(1e-4)


def test_with_shares_the_learning_rates_bound_falls_with_the_frames_of_the_last_stage():
    lengths = StageLengths(SHARES, 1000)

    def bound(stage, frames):
        began = {2: 140, 3: 620}[stage]
        return lengths.learning_rate_bound(in_stage(stage, began, frames), 5e-4, 5e-5)

    assert bound(2, 619) == 5e-4
    assert bound(3, 620) == pytest.approx(5e-4)
    assert bound(3, 810) == pytest.approx(2.75e-4)
    assert bound(3, 1000) == pytest.approx(5e-5)
