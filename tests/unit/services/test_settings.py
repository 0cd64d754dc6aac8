"""Settings that no run could work with are refused as one line; those beside them are not."""

import pytest

from common.config import ConfigError, load
from deploy.config import shared_out
from deploy.local import settings as run_settings
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
            "learner.network.units = '0' (--network.units); allowed: list of a whole number, from 1",
        ),
        (
            learner,
            ["--network.units", "-3,4"],
            "learner.network.units = '-3' (--network.units); allowed: list of a whole number, from 1",
        ),
        (
            learner,
            ["--network.units="],
            "learner.network.units = [] (--network.units); allowed: list of a whole number, from 1",
        ),
        (generator, ["--index", "1"], "generator: index 1; allowed: 0 to 0, of 1 generators"),
        (generator, ["--index", "3", "--of", "3"], "generator: index 3; allowed: 0 to 2, of 3 generators"),
    ],
)
def test_what_could_never_work_is_one_line_that_says_what_is_allowed(read, argv, line):
    with pytest.raises(ConfigError) as caught:
        read(*argv)

    assert str(caught.value) == line


@pytest.mark.parametrize(
    ("read", "argv"),
    [
        (learner, [DATASET, "256"]),
        (learner, [DATASET, "300", QUEUE, "300"]),
        (learner, [RATE_MIN, "4e-6", RATE_MAX, "1.2e-5"]),  # below what the rate starts from: it is clipped
        (learner, [RATE_MIN, "1e-3", RATE_MAX, "1e-3"]),
        (learner, ["--network.units", "1"]),
        (generator, ["--index", "1", "--of", "2"]),
    ],
)
def test_the_nearest_that_works_is_taken(read, argv):
    read(*argv)


def test_a_run_of_more_actors_than_the_queue_has_places_gets_a_longer_one():
    intake = shared_out(run_settings(["--run", "r", "--actors", "300"])).learner.intake

    assert (intake.dataset_rollouts, intake.queue_rollouts) == (300, 600)
    assert type(intake)(**intake.model_dump()) == intake
