import numpy as np
import pytest
import torch

from common.policy.actor_critic import NetworkConfig, log_prob
from common.policy.weights import new_network
from services.learner.ppo import (
    Dataset,
    PPOConfig,
    adapted_learning_rate,
    bound_loss,
    explained_variance,
    policy_loss,
    update,
)


def column(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_the_loss_of_a_hand_worked_case():
    # ratios 1.5 (clipped to 1.2), 0.5 (not clipped: the advantage pulls it down anyway, min keeps 0.8), 1.1
    log_prox = column(0.0, 0.0, 0.0)
    log_new = torch.log(column(1.5, 0.5, 1.1))
    advantages = column(2.0, -1.0, 3.0)

    loss = policy_loss(log_new, log_prox, log_prox, advantages, clip=0.2)

    # min(1.5*2, 1.2*2) = 2.4; min(.5*-1, .8*-1) = -.8; 1.1*3 = 3.3
    assert float(loss) == pytest.approx(-(2.4 - 0.8 + 3.3) / 3)


def test_old_data_are_weighted_by_how_likely_they_still_are_at_most_twice():
    log_mu = column(0.0, 0.0)
    log_prox = torch.log(column(0.5, 8.0))

    loss = policy_loss(log_prox, log_prox, log_mu, column(1.0, 1.0), clip=0.2)

    assert float(loss) == pytest.approx(-(0.5 + 2.0) / 2)


def test_at_lag_0_decoupled_ppo_is_plain_ppo():
    rng = np.random.default_rng(0)
    log_mu = torch.from_numpy(rng.normal(size=200))
    log_new = (log_mu + torch.from_numpy(rng.normal(size=200)) * 0.3).requires_grad_()
    advantages = torch.from_numpy(rng.normal(size=200))

    ratio = torch.exp(log_new - log_mu)
    plain = -torch.min(ratio * advantages, torch.clamp(ratio, 0.8, 1.2) * advantages).mean()
    decoupled = policy_loss(log_new, log_mu, log_mu, advantages, clip=0.2)

    torch.testing.assert_close(decoupled, plain)
    torch.testing.assert_close(
        torch.autograd.grad(decoupled, log_new)[0], torch.autograd.grad(plain, log_new)[0]
    )


def test_targets_beyond_the_joints_range_cost_their_squared_excess():
    mean = torch.tensor([[0.5, -1.0, 1.5], [-3.0, 0.0, 0.0]])

    assert float(bound_loss(mean)) == pytest.approx((0.25 + 4.0) / 2)


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
        log_sigma = network.log_sigma.clone()
        actions = mean + log_sigma.exp() * torch.randn(mean.shape, generator=generator)
        log_mu = log_prob(actions, mean, log_sigma)
    advantages = (actions[:, 0] - mean[:, 0]) * torch.sign(obs[:, 0])
    advantages = (advantages - advantages.mean()) / advantages.std()
    nothing = torch.zeros_like(mean)
    return Dataset(
        obs, actions, log_mu, log_mu.clone(), mean, log_sigma, advantages, obs[:, 1].clone(), nothing
    )


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
            1e-3,
            1e-3,
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


def test_holding_the_policy_fits_the_value_and_leaves_the_actions():
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 32)))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    data = make_data(network)
    config = PPOConfig(minibatch=128, mini_epochs=8)

    for k in range(10):
        stats = update(
            network, optimizer, data, config, 1e-3, 1e-3, torch.Generator().manual_seed(k), hold_policy=True
        )

    with torch.no_grad():
        mean, value = network(data.obs)
    assert torch.equal(mean, data.mean_prox)
    assert torch.equal(network.log_sigma, data.log_sigma_prox)
    assert float((value - data.value_targets).square().mean()) < 0.9 * float(data.value_targets.var())
    assert stats.learning_rate == 1e-3


def test_a_gradient_that_is_not_finite_is_skipped_and_told():
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
        1e-3,
        1e-3,
        torch.Generator(),
    )

    assert not stats.finite
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])
