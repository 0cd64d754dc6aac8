"""Settings that can't work are refused with one line; the nearest ones that work are not."""

import pytest

from common.errors import ConfigError
from common.service.config import load
from services.generator.config import GeneratorConfig
from services.learner.config import LearnerConfig

RATE_MIN, RATE_MAX = "--ppo.learning-rate-min", "--ppo.learning-rate-max"
DATASET, QUEUE = "--intake.dataset-rollouts", "--intake.queue-rollouts"


def learner(*argv: str) -> LearnerConfig:
    return load(LearnerConfig, argv, prog="learner", section="learner", environ={})


def generator(*argv: str) -> GeneratorConfig:
    return load(GeneratorConfig, argv, prog="generator", section="generator", environ={})


@pytest.mark.parametrize(
    ("read", "argv", "line"),
    [
        (
            learner,
            [DATASET, "300"],
            "learner.intake: dataset_rollouts 300; allowed: up to queue_rollouts, 256",
        ),
        (
            learner,
            [DATASET, "2", QUEUE, "1"],
            "learner.intake: dataset_rollouts 2; allowed: up to queue_rollouts, 1",
        ),
        (
            learner,
            [RATE_MIN, "0.01"],
            "learner.ppo: learning_rate_min 0.01; allowed: up to learning_rate_max, 0.001",
        ),
        (
            learner,
            [RATE_MAX, "1e-5"],
            "learner.ppo: learning_rate_min 2e-05; allowed: up to learning_rate_max, 1e-05",
        ),
        (
            learner,
            ["--network.units", "64,0"],
            "network.units = '0' (--network.units); allowed: list of a whole number, from 1 to 4096",
        ),
        (
            learner,
            ["--network.units", "-3,4"],
            "network.units = '-3' (--network.units); allowed: list of a whole number, from 1 to 4096",
        ),
        (
            learner,
            ["--network.units="],
            "network.units = [] (--network.units); allowed: list of a whole number, from 1 to 4096",
        ),
        (generator, ["--index", "1"], "generator: index 1; allowed: 0 to 0, of 1 generators"),
        (
            generator,
            ["--index", "3", "--generators", "3"],
            "generator: index 3; allowed: 0 to 2, of 3 generators",
        ),
    ],
)
def test_settings_that_cannot_work_are_one_line_that_says_what_is_allowed(read, argv, line):
    with pytest.raises(ConfigError) as caught:
        read(*argv)

    assert str(caught.value) == line


@pytest.mark.parametrize(
    ("read", "argv"),
    [
        (learner, [DATASET, "256"]),
        (learner, [DATASET, "300", QUEUE, "300"]),
        (learner, [RATE_MIN, "4e-6", RATE_MAX, "1.2e-5"]),  # below the starting rate, which is clipped
        (learner, [RATE_MIN, "1e-3", RATE_MAX, "1e-3"]),
        (learner, ["--network.units", "1"]),
        (generator, ["--index", "1", "--generators", "2"]),
    ],
)
def test_the_nearest_settings_that_work_are_accepted(read, argv):
    read(*argv)


def test_a_run_of_more_actors_than_the_queue_has_places_gets_a_longer_one():
    intake = learner("--actors", "300").intake.for_actors(300)

    assert (intake.dataset_rollouts, intake.queue_rollouts) == (300, 600)
    assert type(intake)(**intake.model_dump()) == intake


def test_a_teacher_without_effect_is_refused():
    with pytest.raises(
        ConfigError, match=r"ppo\.correction_weight 0 with experience\.teacher\.policy; allowed: above 0"
    ):
        learner("--experience.teacher.policy", "default", "--ppo.correction-weight", "0")
