from dataclasses import replace

import numpy as np
import pytest
import torch

from common.policy.actor_critic import log_prob
from common.policy.config import NetworkConfig
from common.policy.weights import new_network
from services.learner.compute import compute_of
from services.learner.config import PPOConfig
from services.learner.engine import CpuEngine, kl_sum
from services.learner.minibatches import Dataset
from services.learner.ppo import LearningRate, UpdateMode, adapted_learning_rate, explained_variance
from services.learner.ppo import update as update_by


def update(network, optimizer, data, config, *arguments, **named):
    """Update with an optimiser of the network's parameters, which keeps its moments from call to call."""
    engine = CpuEngine(network, lambda _: optimizer, config.largest_minibatch, compute_of(config).precision)
    return update_by(engine, data, config, *arguments, **named)


@pytest.mark.parametrize(
    ("kl", "expected"), [(0.05, 4e-4 / 1.5), (0.001, 6e-4), (0.01, 4e-4), (1.0, 4e-4 / 1.5)]
)
def test_the_learning_rate_follows_the_divergence(kl, expected):
    assert adapted_learning_rate(4e-4, kl, 1e-4, 1e-3, target=0.01) == pytest.approx(expected)


def test_the_learning_rate_stays_within_its_bounds():
    assert adapted_learning_rate(1e-4, 1.0, 1e-4, 1e-3, target=0.01) == 1e-4
    assert adapted_learning_rate(1e-3, 0.0, 1e-4, 1e-3, target=0.01) == 1e-3


def test_explained_variance_is_1_for_perfect_and_0_for_constant_values():
    targets = np.random.default_rng(0).normal(size=100).astype(np.float32)

    assert explained_variance(targets, targets) == pytest.approx(1.0)
    assert explained_variance(targets, np.zeros(100, np.float32)) == pytest.approx(0.0, abs=1e-6)


def make_data(network, count=512, seed=0):
    """A bandit: the first action component should rise wherever the first observation is positive."""
    generator = torch.Generator().manual_seed(seed)
    obs = torch.randn(count, 37, generator=generator)
    with torch.no_grad():
        mean, _ = network(obs)
        log_std = network.log_std.clone()
        actions = mean + log_std.exp() * torch.randn(mean.shape, generator=generator)
        log_mu = log_prob(actions, mean, log_std)
    advantages = (actions[:, 0] - mean[:, 0]) * torch.sign(obs[:, 0])
    advantages = (advantages - advantages.mean()) / advantages.std()
    nothing = torch.zeros_like(mean)
    return Dataset(
        obs,
        actions,
        log_mu,
        log_mu.clone(),
        mean,
        advantages,
        obs[:, 1].clone(),
        nothing,
        log_std,
    )


def test_the_divergence_is_the_gaussians():
    generator = torch.Generator().manual_seed(0)
    old, new = (torch.randn(7, generator=generator) * 0.3 - 1.0 for _ in range(2))
    data = replace(make_data(new_network(NetworkConfig(units=(16,))), 64), log_std_prox=old)
    mean = data.mean_prox + 0.2 * torch.randn(64, 7, generator=generator)
    moved = (mean - data.mean_prox).double().square().sum(0)
    p = torch.distributions.Normal(data.mean_prox.double(), old.double().exp())
    q = torch.distributions.Normal(mean.double(), new.double().exp())

    expected = float(torch.distributions.kl_divergence(p, q).sum())
    assert float(kl_sum(data, moved, new)) == pytest.approx(expected, rel=1e-5)


def test_an_update_moves_the_policy_where_the_advantage_points_and_fits_the_value():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    config = PPOConfig(minibatch=128, mini_epochs=4)
    stats = [
        update(
            network,
            optimizer,
            make_data(network, seed=k),
            config,
            LearningRate(1e-3, 1e-3),
            torch.Generator().manual_seed(k),
        )
        for k in range(25)
    ]

    probe = make_data(network, seed=99)
    positive = probe.obs[:, 0] > 0
    assert probe.mean_prox[positive, 0].mean() - probe.mean_prox[~positive, 0].mean() > 0.1
    assert stats[-1].value_loss < 0.5 * stats[0].value_loss
    assert stats[0].weight == pytest.approx(1.0)
    assert all(s.finite for s in stats)


def test_critic_only_fits_the_value_and_leaves_the_actions():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    data = make_data(network)
    config = PPOConfig(minibatch=128, mini_epochs=8)

    for k in range(10):
        stats = update(
            network,
            optimizer,
            data,
            config,
            LearningRate(1e-3, 1e-3),
            torch.Generator().manual_seed(k),
            mode=UpdateMode.CRITIC_ONLY,
        )

    with torch.no_grad():
        mean, value = network(data.obs)
    assert torch.equal(mean, data.mean_prox)
    assert torch.equal(network.log_std, data.log_std_prox)
    assert float((value - data.value_targets).square().mean()) < 0.9 * float(data.value_targets.var())
    assert stats.learning_rate == 1e-3


def test_a_gradient_that_is_not_finite_is_skipped_and_reported():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(16,)))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    data = make_data(network, count=64)
    data.advantages[:] = float("nan")

    stats = update(
        network,
        torch.optim.Adam(network.parameters()),
        data,
        PPOConfig(minibatch=64, mini_epochs=1),
        LearningRate(1e-3, 1e-3),
        torch.Generator(),
    )

    assert not stats.finite
    assert stats.learning_rate == pytest.approx(1e-3 / 1.5)
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])


def make_corrections(count=512, share=0.2, seed=0):
    """Return corrections (count, 7): some rows, and in each of them some joints."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(size=(count, 1)) < share
    return torch.from_numpy((0.1 * rng.normal(size=(count, 7)) * rows).astype(np.float32))


def updated(corrections, weight, advantages=1.0, passes=2):
    """Return the network after updates with these corrections, its dataset and the last statistics."""
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    data = make_data(network)
    data = replace(data, corrections=corrections, advantages=advantages * data.advantages)
    config = PPOConfig(minibatch=128, mini_epochs=passes, correction_weight=weight)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    stats = update(
        network, optimizer, data, config, LearningRate(1e-3, 1e-3), torch.Generator().manual_seed(0)
    )
    return network, data, stats


def test_without_weight_or_corrections_it_is_plain_ppo_bit_for_bit():
    plain, _, _ = updated(torch.zeros(512, 7), weight=0.0)
    unweighted, _, _ = updated(make_corrections(), weight=0.0)
    uncorrected, _, stats = updated(torch.zeros(512, 7), weight=1000.0)

    assert stats.correction_loss == 0.0
    for a, b, c in zip(plain.parameters(), unweighted.parameters(), uncorrected.parameters(), strict=True):
        assert torch.equal(a, b)
        assert torch.equal(a, c)


def test_an_update_moves_the_mean_towards_the_corrections():
    corrections = make_corrections() + 0.0
    corrections[(corrections != 0).any(-1)] = torch.tensor([0.1, -0.1, 0.05, 0.0, 0.0, 0.1, -0.05])
    network, data, stats = updated(corrections, weight=1000.0, passes=8)
    says = (corrections != 0).any(-1)
    with torch.no_grad():
        moved = (network(data.obs)[0] - data.mean_prox)[says]
    before, after = (float((m - corrections[says]).square().sum(-1).mean()) for m in (0.0 * moved, moved))

    assert after < 0.5 * before
    assert float((moved * corrections[says]).sum(-1).mean()) > 0
    assert stats.correction_loss > 0


def test_a_distilled_policy_learns_the_teachers_actions_and_nothing_from_rewards():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    wanted = torch.full((7,), 0.3)
    config = PPOConfig(minibatch=128, mini_epochs=4)

    def distilled(seed):
        data = make_data(network, seed=seed)
        data = replace(data, corrections=wanted - data.actions)  # for any action
        return data, update(
            network,
            optimizer,
            data,
            config,
            LearningRate(2e-3, 1e-4),
            torch.Generator().manual_seed(seed),
            mode=UpdateMode.DISTILL,
        )

    first, stats = distilled(0)
    for seed in range(1, 30):
        last = distilled(seed)[1]

    with torch.no_grad():
        mean, _ = network(make_data(network, seed=99).obs)
    torch.testing.assert_close(mean, wanted.expand_as(mean), atol=0.03, rtol=0)
    assert torch.equal(network.log_std, first.log_std_prox)
    assert stats.policy_loss == 0.0
    assert stats.learning_rate == 2e-3  # no trust region changes it
    assert last.correction_loss < 0.01 * stats.correction_loss
    assert last.value_loss < stats.value_loss


def test_a_larger_dataset_has_larger_minibatches_by_default():
    """Three passes over 16,384 frames are twelve steps of 4,096, and their engine is made for any dataset."""
    network = new_network(NetworkConfig(units=(8,)))
    config = PPOConfig(mini_epochs=3)
    engine = CpuEngine(network, torch.optim.Adam, config.largest_minibatch, "float32")
    ticks = []

    update_by(
        engine,
        make_data(network, 16_384),
        config,
        LearningRate(1e-4, 1e-3),
        torch.Generator().manual_seed(0),
        on_tick=lambda: ticks.append(1),
    )

    assert len(ticks) == 12


def test_critic_only_applies_no_correction():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    data = replace(make_data(network), corrections=make_corrections())
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    stats = update(
        network,
        optimizer,
        data,
        PPOConfig(minibatch=128),
        LearningRate(1e-3, 1e-3),
        torch.Generator().manual_seed(0),
        mode=UpdateMode.CRITIC_ONLY,
    )

    with torch.no_grad():
        assert torch.equal(network(data.obs)[0], data.mean_prox)
    assert stats.correction_loss == 0.0
