"""What an epoch's data are made of: normalised advantages and value targets over all rollouts together."""

from dataclasses import replace

import numpy as np
import pytest

from common.policy.config import NetworkConfig
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.curriculum import StageLengths
from services.learner.training import Training
from tests.unit.services.learner.rollouts import make_rollout


def make_training(**ppo):
    settings = PPOConfig(minibatch=64, **{"mini_epochs": 1, "gae_lambda": 0.0, "precision": "float32", **ppo})
    return Training(
        settings, NetworkConfig(units=(16, 8)), StageLengths(CurriculumConfig()), np.zeros(7, np.float32), 0
    )


def rollouts_of(mean, spread):
    """Return two rollouts whose rewards differ in size; every frame ends its episode, so that A = r - V."""
    every = np.ones((16, 8), bool)
    made = [make_rollout(seed, terminated=every, truncated=~every) for seed in (1, 2)]
    made = [
        replace(one, final_obs=np.zeros((0, 37), np.float32), final_index=np.zeros(0, np.int32))
        for one in made
    ]
    return [
        replace(made[0], rewards=spread * made[0].rewards),
        replace(made[1], rewards=mean + made[1].rewards),
    ]


@pytest.mark.parametrize(("mean", "spread"), [(0.0, 1.0), (300.0, 1.0), (-5.0, 400.0)])
def test_advantages_have_mean_0_and_deviation_1_over_all_rollouts(mean, spread):
    advantages = make_training().read(rollouts_of(mean, spread)).data.advantages.numpy()

    assert advantages.mean() == pytest.approx(0.0, abs=1e-5)
    assert advantages.std() == pytest.approx(1.0, abs=1e-4)


def test_rollouts_are_normalised_together_and_not_one_by_one():
    """The better rollout has the higher advantages: 16 x 8 rewards of about 0 and of about 3,000."""
    advantages = make_training().read(rollouts_of(3000.0, 1.0)).data.advantages.numpy()

    assert advantages[:128].max() < -0.9
    assert advantages[128:].min() > 0.9


def test_the_scale_of_rewards_changes_no_advantage():
    usual, larger = (
        make_training(reward_scale=scale).read(rollouts_of(400.0, 200.0)).data.advantages.numpy()
        for scale in (1.0, 10.0)
    )
    # V of a new critic is below 3, and the rewards differ by 200
    np.testing.assert_allclose(usual, larger, atol=0.05)


def test_rewards_are_scaled_before_anything_else():
    """With every frame the last of its episode the value targets are the scaled rewards."""
    batch = make_training(reward_scale=0.1).read(rollouts_of(300.0, 1.0))
    targets = batch.data.value_targets.numpy() * np.sqrt(batch.value_moments.var + 1e-5)
    targets += batch.value_moments.mean

    assert targets[128:].mean() == pytest.approx(30.0, abs=0.1)
    assert np.abs(targets[:128]).max() < 0.5


def test_value_targets_are_normalised_by_the_moments_after_these_returns():
    """The moments start with mean 0 and variance 1 as one sample, so 256 returns decide them."""
    batch = make_training().read(rollouts_of(0.0, 100.0))
    targets = batch.data.value_targets.numpy()

    assert targets.std() == pytest.approx(1.0, abs=0.02)
    assert targets.mean() == pytest.approx(0.0, abs=0.02)
