import math

import pytest

from services.learner.curriculum import CurriculumConfig, learning_rate_bound, next_stage

CONFIG = CurriculumConfig(stage_1=3, stage_2=2, stage_3=10)


def stages(config, epochs, catch=math.nan):
    stage, inside, seen = config.first_stage, 0, []
    for _ in range(epochs):
        seen.append(stage)
        following = next_stage(stage, inside + 1, catch, config)
        inside = inside + 1 if following == stage else 0
        stage = following
    return seen


def test_each_stage_lasts_its_number_of_epochs():
    assert stages(CONFIG, 8) == [1, 1, 1, 2, 2, 3, 3, 3]


def test_a_gate_ends_stage_1_early_once_enough_is_caught():
    config = CONFIG.model_copy(update={"catch_gate": 0.9})

    assert next_stage(1, 1, 0.89, config) == 1
    assert next_stage(1, 1, 0.9, config) == 2
    assert next_stage(1, 1, math.nan, config) == 1


def test_the_curriculum_can_be_skipped():
    config = CONFIG.model_copy(update={"first_stage": 3})

    assert stages(config, 5) == [3] * 5
    assert config.epochs == 10


def test_the_learning_rates_bound_falls_in_the_last_stage_only():
    assert learning_rate_bound(1, 2, 1e-3, 1e-4, CONFIG) == 1e-3
    assert learning_rate_bound(2, 1, 1e-3, 1e-4, CONFIG) == 1e-3
    assert learning_rate_bound(3, 0, 1e-3, 1e-4, CONFIG) == 1e-3
    assert learning_rate_bound(3, 5, 1e-3, 1e-4, CONFIG) == pytest.approx(5.5e-4)
    assert learning_rate_bound(3, 99, 1e-3, 1e-4, CONFIG) == pytest.approx(1e-4)
