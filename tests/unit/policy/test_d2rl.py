from itertools import pairwise

import numpy as np
import pytest
import torch

from common.policy.actor_critic import ActorCritic, entropy, log_prob
from common.policy.config import NetworkConfig
from common.policy.d2rl import D2RL
from common.policy.normalizer import Moments, normalize
from common.policy.weights import new_network
from common.task.observation import PAPER_OBSERVATION, PRIVILEGED, size

PAPER_UNITS = (256, 128, 128, 64, 64, 32)

TRUTH = size(PRIVILEGED)


def by_hand(trunk, obs):
    """D2RL as in its paper, with plain matrix products."""
    hidden = None
    for k, layer in enumerate(trunk.layers):
        seen = obs if k == 0 else np.concatenate((hidden, obs))
        z = layer.weight.detach().numpy().astype(np.float64) @ seen + layer.bias.detach().numpy()
        hidden = np.where(z > 0, z, np.exp(np.minimum(z, 0)) - 1)
    return hidden


def test_every_hidden_layer_after_the_first_takes_the_observation_again():
    torch.manual_seed(0)
    trunk = D2RL(37, PAPER_UNITS)
    obs = np.random.default_rng(0).normal(size=37)

    with torch.no_grad():
        got = trunk(torch.from_numpy(obs.astype(np.float32))[None])[0].numpy()

    assert [layer.in_features for layer in trunk.layers] == [
        37,
        256 + 37,
        128 + 37,
        128 + 37,
        64 + 37,
        64 + 37,
    ]
    np.testing.assert_allclose(got, by_hand(trunk, obs), atol=2e-5)


def test_the_papers_trunk_has_its_published_number_of_parameters():
    count = sum(p.numel() for p in D2RL(37, PAPER_UNITS).parameters())

    assert count == 89_024


def test_actor_and_critic_share_all_but_the_last_layers():
    network = new_network(NetworkConfig())

    assert sum(p.numel() for p in network.parameters()) == 89_024 + 264 + 7


def test_training_starts_from_a_robot_that_holds_its_home_pose():
    home = np.linspace(-0.9, 0.9, 7, dtype=np.float32)
    network = ActorCritic(37, 7, NetworkConfig(), home)

    mean, value = network(torch.zeros(5, 37))

    assert mean.shape == (5, 7)
    assert value.shape == (5,)
    np.testing.assert_allclose(mean.detach().numpy(), np.tile(home, (5, 1)), atol=1e-3)
    np.testing.assert_allclose(network.log_std.detach().numpy(), -1.6)


def test_log_probability_and_entropy_are_the_gaussians():
    rng = np.random.default_rng(1)
    mean, actions = (torch.from_numpy(rng.normal(size=(4, 7))) for _ in range(2))
    log_std = torch.from_numpy(rng.normal(size=7) * 0.3)
    p = torch.distributions.Normal(mean, log_std.exp())

    torch.testing.assert_close(log_prob(actions, mean, log_std), p.log_prob(actions).sum(-1))
    torch.testing.assert_close(entropy(log_std), p.entropy().sum(-1)[0])


def test_a_privileged_critic_observes_the_truth_and_the_policy_does_not():
    torch.manual_seed(0)
    network = new_network(
        NetworkConfig(units=(16, 8)), PAPER_OBSERVATION.model_copy(update={"critic": "privileged"})
    )
    obs = torch.randn(4, 37 + TRUTH)
    other = obs.clone()
    other[:, 37:] = torch.randn(4, TRUTH)

    with torch.no_grad():
        (mean, value), (mean_other, value_other) = network(obs), network(other)
        alone = network.act(obs[:, :37])

    assert torch.equal(mean, mean_other)
    assert torch.equal(mean, alone)
    assert (value - value_other).abs().min() > 1e-4


@pytest.mark.parametrize("critic", ["policy", "privileged"])
def test_a_renormalized_network_computes_the_same_with_other_moments(critic):
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    config = PAPER_OBSERVATION.model_copy(update={"critic": critic})
    network = new_network(NetworkConfig(units=(32, 16, 8)), config)
    width = 37 + TRUTH * (critic == "privileged")
    old = Moments(rng.normal(size=width), rng.uniform(0.5, 2.0, size=width), 1)
    new = Moments(old.mean + 0.3 * rng.normal(size=width), old.var * rng.uniform(0.5, 2.0, size=width), 1)
    raw = (old.mean + 0.5 * rng.normal(size=(64, width))).astype(np.float32)

    with torch.no_grad():
        before = network(torch.from_numpy(normalize(raw, old)))
        changed = network(torch.from_numpy(normalize(raw, new)))
        network.renormalize(old, new)
        after = network(torch.from_numpy(normalize(raw, new)))

    torch.testing.assert_close(after, before, atol=2e-5, rtol=1e-4)
    assert (changed[1] - before[1]).abs().max() > 0.01


def test_a_flag_that_becomes_common_does_not_change_the_policy():
    """Its variance becomes a thousand times larger, and where it is 1 both normalised values are near the clip."""
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(32, 16)))
    torch.nn.init.orthogonal_(network.mean.weight, 0.3)
    raw = np.zeros((1, 37), np.float32)
    raw[0, 36] = 1.0
    mean, var = np.zeros(37), np.ones(37)

    def share(p):
        m, v = mean.copy(), var.copy()
        m[36], v[36] = p, p * (1 - p)
        return Moments(m, v, 1)

    with torch.no_grad():
        before = network.act(torch.from_numpy(normalize(raw, share(1e-5))))
        for old, new in pairwise((1e-5, 1e-4, 1e-3, 0.01, 0.02)):
            network.renormalize(share(old), share(new))
        after = network.act(torch.from_numpy(normalize(raw, share(0.02))))

    assert (after - before).abs().max() < 0.5 * before.abs().max()
