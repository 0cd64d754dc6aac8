"""The written-out pass computes what the module and autograd compute."""

import numpy as np
import pytest
import torch

from common.policy.actor_critic import ActorCritic
from common.policy.config import NetworkConfig
from common.policy.network_pass import NetworkPass

OBSERVED, PRIVILEGED, ACTIONS = 37, 17, 7
SHAPES = [((256, 128, 64, 32), PRIVILEGED), ((256, 128, 64, 32), 0), ((48,), PRIVILEGED), ((48,), 0)]


def make_network(units=(64, 32), privileged=PRIVILEGED, seed=0):
    torch.manual_seed(seed)
    network = ActorCritic(
        OBSERVED,
        ACTIONS,
        NetworkConfig(units=units),
        np.linspace(-0.5, 0.5, ACTIONS, dtype=np.float32),
        privileged,
    )
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.endswith("bias"):
                parameter.add_(0.3 * torch.randn(parameter.shape))
    return network


def make_slopes(network, count, seed=1):
    """Return observations, and slopes of a loss with respect to mean actions and values."""
    generator = torch.Generator().manual_seed(seed)
    wide = OBSERVED + (PRIVILEGED if network.critic_head is not None else 0)
    return tuple(
        torch.randn(shape, generator=generator) for shape in ((count, wide), (count, ACTIONS), (count,))
    )


def by_autograd(network, obs, mean_slope, value_slope, precision):
    """Return outputs and gradients, as the module and autograd have them."""
    network.zero_grad()
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        mean, value = network(obs)
    torch.autograd.backward([mean.float(), value.float()], [mean_slope, value_slope])
    return mean.detach().float(), value.detach().float(), gradients(network)


def differentiated(written, obs, mean_slope, value_slope):
    """Return outputs and gradients, as the written-out pass has them."""
    gradient, _ = written.gradient_of(mean_slope is not None, False)
    gradient.fill_(float("nan"))  # of an earlier step nothing stays
    outputs = written.forward(obs)
    written.backward(mean_slope, value_slope)
    return *outputs, gradients(written.network)


def gradients(network):
    return {
        name: parameter.grad.clone()
        for name, parameter in network.named_parameters()
        if parameter.grad is not None
    }


# a bfloat16 has 8 bits: a slope is rounded once a layer, to 0.4 %
@pytest.mark.parametrize(
    ("precision", "outputs", "slopes"), [("float32", 1e-5, 1e-4), ("bfloat16", 0.02, 0.03)]
)
@pytest.mark.parametrize(("units", "privileged"), SHAPES)
def test_outputs_and_gradients_are_autograds(units, privileged, precision, outputs, slopes):
    network = make_network(units, privileged)
    obs, mean_slope, value_slope = make_slopes(network, 300)
    mean, value, expected = by_autograd(network, obs, mean_slope, value_slope, precision)
    written = NetworkPass(network, 512, precision)
    got_mean, got_value, got = differentiated(written, obs, mean_slope, value_slope)

    torch.testing.assert_close(got_mean, mean, atol=outputs, rtol=0)
    torch.testing.assert_close(got_value, value, atol=outputs, rtol=0)
    assert got.keys() == expected.keys()
    assert "log_std" not in got
    for name, gradient in expected.items():
        assert float((got[name] - gradient).norm()) <= slopes * float(gradient.norm()), name


def test_bfloat16_loses_no_more_than_autograd_does():
    """Both are compared with float64."""
    network = make_network((256, 128, 128, 64, 64, 32))
    obs, mean_slope, value_slope = make_slopes(network, 2048)
    exact = make_network((256, 128, 128, 64, 64, 32)).double()
    *_, truth = by_autograd(exact, obs.double(), mean_slope.double(), value_slope.double(), "float32")
    *_, autograd = by_autograd(network, obs, mean_slope, value_slope, "bfloat16")
    written = NetworkPass(network, 2048, "bfloat16")
    *_, got = differentiated(written, obs, mean_slope, value_slope)

    for name, gradient in truth.items():
        lost, loses = (float((g[name] - gradient).norm() / gradient.norm()) for g in (autograd, got))
        assert loses < 1.2 * lost + 1e-3, name


@pytest.mark.parametrize("privileged", [PRIVILEGED, 0])
def test_a_critic_that_learns_alone_has_its_gradient_and_the_policy_none(privileged):
    network = make_network(privileged=privileged)
    obs, mean_slope, value_slope = make_slopes(network, 64)
    *_, expected = by_autograd(network, obs, mean_slope, value_slope, "float32")
    *_, got = differentiated(NetworkPass(network, 64, "float32"), obs, None, value_slope)

    assert {name.split(".")[0] for name in got} == ({"critic_head", "value"} if privileged else {"value"})
    for name, gradient in got.items():
        torch.testing.assert_close(gradient, expected[name], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("learns_policy", "learns_noise"), [(True, True), (True, False), (False, False)])
def test_one_array_holds_the_gradients_of_what_learns_and_of_nothing_else(learns_policy, learns_noise):
    network = make_network()
    written = NetworkPass(network, 64, "float32")
    written.gradient_of(True, True)
    gradient, noise = written.gradient_of(learns_policy, learns_noise)
    gradient.copy_(torch.arange(len(gradient)))
    policy = {id(parameter) for parameter in network.policy_parameters()}
    learning = {
        name: parameter
        for name, parameter in network.named_parameters()
        if (learns_noise if name == "log_std" else learns_policy or id(parameter) not in policy)
    }

    assert {name for name, p in network.named_parameters() if p.grad is not None} == learning.keys()
    held = torch.cat([parameter.grad.reshape(-1) for parameter in learning.values()])
    assert torch.equal(held.sort().values, torch.arange(len(gradient), dtype=torch.float32))
    assert torch.equal(noise, network.log_std.grad) if learns_noise else len(noise) == 0


def test_it_follows_the_parameters_and_a_small_batch_leaves_nothing_of_a_large_one():
    network = make_network()
    written = NetworkPass(network, 128, "float32")
    written.forward(make_slopes(network, 128, seed=5)[0])
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(0.7)
    written.refresh()
    obs, mean_slope, value_slope = make_slopes(network, 50)
    mean, value, expected = by_autograd(network, obs, mean_slope, value_slope, "float32")
    got_mean, got_value, got = differentiated(written, obs, mean_slope, value_slope)

    torch.testing.assert_close(got_mean, mean)
    torch.testing.assert_close(got_value, value)
    for name, gradient in got.items():
        torch.testing.assert_close(gradient, expected[name], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("count", [1, 64, 65, 200])
def test_any_number_of_observations_is_evaluated_and_the_result_is_kept(count):
    network = make_network()
    written = NetworkPass(network, 64, "float32")
    obs = make_slopes(network, count)[0]
    with torch.no_grad():
        mean, value = network(obs)
    got = written.evaluate(obs)
    written.evaluate(torch.zeros_like(obs))

    torch.testing.assert_close(got[0], mean)
    torch.testing.assert_close(got[1], value)


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bfloat16", 0.02)])
def test_the_policy_acts_without_the_critic_as_with_it(precision, tolerance):
    network = make_network()
    obs = make_slopes(network, 40)[0]
    got = NetworkPass(network, 64, precision).act(obs[:, :OBSERVED].contiguous())

    with torch.no_grad():
        torch.testing.assert_close(got, network(obs)[0], atol=tolerance, rtol=0)
