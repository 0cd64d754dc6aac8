"""Divergence: detected after the patience, never before a stage has learned, and what a rollback keeps."""

import numpy as np
import pytest
import torch

from common.policy.config import NetworkConfig
from common.policy.normalizer import normalize
from services.learner import checkpoint
from services.learner.checkpoint import Extras, keep, restore, save
from services.learner.config import CurriculumConfig, DivergenceConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.divergence import Health, divergence, watched
from services.learner.epoch_stats import Progress
from services.learner.training import Training
from tests.unit.services.learner.rollouts import ROLLOUT_FRAMES, make_rollout

LIMITS = DivergenceConfig(collapse=0.5, least=0.2, patience=5)
EXTRAS = Extras(run="r", generation=7, stage_log=[], accounts=[], trained_seconds=1.5)


def history(rates, config=LIMITS):
    health = Health()
    for rate in rates:
        health = watched(health, rate, config)
    return health


def make_training(limits=LIMITS, curriculum=CurriculumConfig(), **ppo):
    return Training(
        PPOConfig(**{"minibatch": 64, "mini_epochs": 2, **ppo}),
        NetworkConfig(units=(16, 8)),
        StageLengths(curriculum),
        np.zeros(7, np.float32),
        0,
        divergence=limits,
    )


def test_a_rate_that_collapses_and_stays_low_is_a_divergence():
    assert divergence(history([0.8] * 30 + [0.1] * 30), True, LIMITS).startswith("rate 0.1")


@pytest.mark.parametrize(
    ("what", "rates"),
    [
        ("a dip that recovers", [0.8] * 30 + [0.0] * 4 + [0.8] * 30),
        ("noise", [0.8, 0.6] * 30),
        ("a start that has learned nothing", [0.15] * 30 + [0.01] * 30),
        ("datasets in which no rally ended", [0.8] * 30 + [float("nan")] * 30),
        ("a slow decline above the share", [0.8] * 30 + [0.5] * 100),
    ],
)
def test_what_is_no_divergence(what, rates):
    assert divergence(history(rates), True, LIMITS) == "", what


@pytest.mark.parametrize(("rate", "low_epochs"), [(0.39, 1), (0.41, 0), (0.45, 0), (0.79, 0)])
def test_a_stage_is_low_below_the_share_of_its_own_best(rate, low_epochs):
    """Best 0.8 and share 0.5: low below 0.4. The rate before is the same, so the running mean stays there."""
    health = watched(Health(rate=rate, best=0.8), rate, LIMITS)

    assert health.low_epochs == low_epochs


@pytest.mark.parametrize(("share", "low_epochs"), [(0.9, 1), (0.6, 0)])
def test_the_share_decides_what_is_low(share, low_epochs):
    """A rate of 0.5 after a best of 0.8: 0.72 is above it, 0.48 is not."""
    config = LIMITS.model_copy(update={"collapse": share})

    assert watched(Health(rate=0.5, best=0.8), 0.5, config).low_epochs == low_epochs


@pytest.mark.parametrize(("best", "low_epochs"), [(0.19, 0), (0.21, 1)])
def test_a_stage_is_checked_once_its_best_has_reached_the_least(best, low_epochs):
    assert watched(Health(rate=0.01, best=best), 0.01, LIMITS).low_epochs == low_epochs


def test_training_has_diverged_after_exactly_the_patience():
    """The best is 0.8, and 5 epochs in a row at 0.1 are the patience."""
    health, found = Health(rate=0.1, best=0.8), []
    for _ in range(6):
        health = watched(health, 0.1, LIMITS)
        found.append(divergence(health, True, LIMITS) != "")

    assert found == [False, False, False, False, True, True]


def test_one_epoch_at_the_share_starts_the_patience_again():
    health = watched(Health(rate=0.5, best=0.8, low_epochs=4), 0.5, LIMITS)

    assert health.low_epochs == 0
    assert divergence(health, True, LIMITS) == ""


def test_the_running_rate_takes_a_fifth_of_each_dataset():
    assert history([0.5, 1.0]).rate == pytest.approx(0.6)
    assert history([0.5, 1.0, 0.1]).rate == pytest.approx(0.5)


@pytest.mark.parametrize(("rate", "is_good"), [(0.77, True), (0.75, False)])
def test_a_good_checkpoint_is_within_5_percent_of_the_best(rate, is_good):
    """0.95 x 0.8 = 0.76."""
    assert Health(rate=rate, best=0.8).is_good == is_good


def test_parameters_that_are_not_finite_are_a_divergence_at_once():
    assert divergence(Health(), False, LIMITS) == "parameters are not finite"


def test_a_share_of_0_never_diverges():
    config = DivergenceConfig(collapse=0.0)

    assert divergence(history([0.9] * 50 + [0.0] * 500, config), True, config) == ""


def test_only_a_stage_near_its_best_gives_a_good_checkpoint():
    assert history([0.8] * 30).is_good
    assert not history([0.8] * 30 + [0.6] * 10).is_good
    assert not Health().is_good


def test_a_rollback_restores_the_network_and_not_the_counts(tmp_path):
    training = make_training()
    training.run_epoch([make_rollout(1)])
    good = save(tmp_path, training, EXTRAS)
    learned = {name: value.clone() for name, value in training.network.state_dict().items()}
    for seed in range(2, 5):
        training.run_epoch([make_rollout(seed)])
    before = training.progress

    training.go_back(lambda t: restore(good, t))

    for name, value in training.network.state_dict().items():
        assert torch.equal(value, learned[name])
    after = training.progress
    assert (after.version, after.epoch, after.frames) == (before.version, before.epoch, before.frames)
    assert after.rollbacks == 1
    assert after.learning_rate <= max(0.5 * before.learning_rate, training.ppo.learning_rate_min)


STAGES = CurriculumConfig(stage_1=2 * ROLLOUT_FRAMES, stage_2=2 * ROLLOUT_FRAMES, stage_3=50 * ROLLOUT_FRAMES)
HELD = {
    "refit_frames": 3 * ROLLOUT_FRAMES,
    "refit_variance": 1.0,
    "learning_rate_min": 3e-3,
    "learning_rate_max": 3e-3,
}


def played_by(training):
    """Return mean actions for usual observations, away from the normaliser's clip."""
    raw = 0.3 * make_rollout(77).obs.reshape(-1, 37)
    with torch.no_grad():
        return training.network(torch.from_numpy(normalize(raw, training.obs_moments)))[0]


def test_a_stage_without_a_measure_goes_back_to_its_start():
    training = make_training(curriculum=STAGES)
    worth = {}
    for seed in range(6):
        progress = training.run_epoch([make_rollout(seed, terminated=np.zeros((16, 8), bool))]).progress
        worth[progress.stage, progress.epochs_in_stage] = progress.is_worth_going_back_to

    assert worth[2, 0]
    assert worth[3, 0]
    assert not worth[3, 1]  # only its critic has learned
    assert not Progress().is_worth_going_back_to


@pytest.mark.parametrize("epochs", [1, 2, 4])
def test_going_back_over_a_stage_change_makes_the_change_again(tmp_path, epochs):
    """At the change itself, in stage 2, or two stages later."""
    training = make_training(curriculum=STAGES)
    training.run_epoch([make_rollout(1)])
    good = save(tmp_path, training, EXTRAS)
    for seed in range(epochs):
        training.run_epoch([make_rollout(2 + seed)])
    before = training.progress
    assert before.stage > 1

    training.go_back(lambda t: restore(good, t))

    after = training.progress
    assert (after.stage, after.stage_number) == (before.stage, before.stage_number)
    assert after.refitting
    assert training.obs_moments.count == 1


@pytest.mark.parametrize("at_its_change", [False, True])
def test_a_critic_that_goes_back_to_the_old_rewards_learns_the_new_ones_first(tmp_path, at_its_change):
    training = make_training(curriculum=STAGES, **HELD)
    training.run_epoch([make_rollout(1)])
    if at_its_change:
        training.run_epoch([make_rollout(2)])
        assert training.progress.refitting
    good = save(tmp_path, training, EXTRAS)
    for seed in range(3, 12):
        training.run_epoch([make_rollout(seed)])
    assert (training.progress.stage, training.progress.refitting) == (3, False)

    training.go_back(lambda t: restore(good, t))

    start = played_by(training)
    for seed in range(20, 23):
        training.run_epoch([make_rollout(seed)])
    assert float((played_by(training) - start).square().mean()) < 1e-9  # rounding, as the normaliser changes
    for seed in range(23, 26):
        training.run_epoch([make_rollout(seed)])
    assert float((played_by(training) - start).square().mean()) > 1e-6


def test_going_back_within_a_stage_leaves_its_critic_and_normaliser_as_they_were(tmp_path):
    training = make_training(curriculum=STAGES, refit_frames=1)
    for seed in range(8):
        training.run_epoch([make_rollout(seed)])
    assert not training.progress.refitting
    good, moments = save(tmp_path, training, EXTRAS), training.obs_moments
    training.run_epoch([make_rollout(9)])

    training.go_back(lambda t: restore(good, t))

    assert training.obs_moments.count == moments.count
    assert not training.progress.refitting


def test_weights_that_are_not_finite_are_reported_with_the_epoch():
    training = make_training()
    with torch.no_grad():
        training.network.mean.weight[0, 0] = float("nan")

    assert training.run_epoch([make_rollout(1)]).diverged == "parameters are not finite"


def test_health_survives_a_checkpoint(tmp_path):
    training = make_training()
    training.run_epoch([make_rollout(1)])
    path = save(tmp_path, training, EXTRAS)
    resumed = make_training()
    restore(path, resumed)

    assert resumed.progress == training.progress
    assert isinstance(resumed.progress.health, Health)


def test_one_good_checkpoint_is_kept_and_outlives_the_newest(tmp_path):
    training = make_training()
    for seed in range(6):
        training.run_epoch([make_rollout(seed)])
        path = save(tmp_path, training, EXTRAS)
        if seed < 2:
            keep(path, tmp_path / checkpoint.GOOD)

    kept = checkpoint.checkpoints(tmp_path / checkpoint.GOOD)
    assert [file.name for file in kept] == ["00000002.safetensors"]
    assert kept[0].name not in [file.name for file in checkpoint.checkpoints(tmp_path)]
    restore(kept[0], training)
    assert training.progress.version == 2
