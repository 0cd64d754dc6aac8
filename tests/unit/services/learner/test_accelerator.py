"""The engine of other devices against the CPU's: both compute here on the CPU, one by autograd, one written out."""

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from common.errors import ReportedError
from common.policy.config import NetworkConfig
from common.policy.weights import new_network
from common.task.observation import ObservationConfig
from services.learner.accelerator import DeviceEngine
from services.learner.compute import compute_of
from services.learner.config import PPOConfig
from services.learner.engine import CpuEngine
from services.learner.ppo import LearningRate, UpdateMode, update
from tests.unit.services.learner.rollouts import make_rollout
from tests.unit.services.learner.test_ppo import make_corrections, make_data
from tests.unit.services.learner.test_training import make_training

CPU = torch.device("cpu")
ADAM = partial(torch.optim.Adam, lr=1e-3, fused=True)
SHARED = ObservationConfig(
    spin="hidden", prediction=False, age=False, critic="policy"
)  # 37 numbers, one trunk
PRIVILEGED = ObservationConfig(spin="hidden", prediction=False, age=False, critic="privileged")


def make_network(observation=SHARED):
    torch.manual_seed(0)
    return new_network(NetworkConfig(units=(32, 16)), observation)


def make_engines(network, precision="float32"):
    return (
        CpuEngine(copy.deepcopy(network), ADAM, 512, precision),
        DeviceEngine(copy.deepcopy(network), ADAM, CPU, precision),
    )


def make_frames(network):
    """Return a dataset for the critic's observations, whose corrections and old data count."""
    data = make_data(new_network(NetworkConfig(units=(8,))))
    generator = torch.Generator().manual_seed(1)
    width = network.obs_size if network.critic_head is None else network.critic_head[0].in_features - 16
    obs = torch.randn(len(data), width, generator=generator)
    with torch.no_grad():
        mean = network(obs)[0]
    return replace(
        data,
        obs=obs,
        mean_prox=mean,
        log_mu=data.log_prox + 0.5 * torch.randn(len(data), generator=generator),
        corrections=make_corrections(),
        log_std_prox=network.log_std.detach().clone(),
    )


def test_the_layout_of_these_networks_is_the_one_that_is_meant():
    assert make_network().critic_head is None
    assert make_network(PRIVILEGED).critic_head is not None


@pytest.mark.parametrize("mode", UpdateMode)
@pytest.mark.parametrize("observation", [SHARED, PRIVILEGED], ids=["one trunk", "privileged critic"])
@pytest.mark.parametrize("entropy_weight", [0.0, 0.01])
def test_an_update_is_the_cpus(mode, observation, entropy_weight):
    network = make_network(observation)
    data = make_frames(network)
    # A remainder of 12 frames of 512 is left out, one of 62 is not
    for minibatch in (100, 75):
        config = PPOConfig(
            minibatch=minibatch, mini_epochs=3, entropy_weight=entropy_weight, bound_weight=0.5, clip=0.05
        )
        engines = make_engines(network)
        rate = LearningRate(1e-3, 1e-3)
        expected, found = (
            update(engine, data, config, rate, torch.Generator().manual_seed(0), mode=mode)
            for engine in engines
        )
        theirs, ours = (engine.network.state_dict() for engine in engines)

        assert any(not torch.equal(value, ours[name]) for name, value in network.state_dict().items())
        for name, value in theirs.items():
            torch.testing.assert_close(ours[name], value, rtol=0, atol=2e-5, msg=name)
        for name in expected.__slots__:
            assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=2e-3, abs=1e-6), name


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_it_evaluates_the_network_as_it_is_after_refresh(precision):
    network = make_network(PRIVILEGED)
    obs = make_frames(network).obs
    _, engine = make_engines(network, precision)
    with torch.no_grad():
        for parameter in engine.network.parameters():
            parameter.mul_(1.5)
        expected = engine.network(obs)
    engine.refresh()

    for found, exact in zip(engine.evaluate(obs), expected, strict=True):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-6 if precision == "float32" else 0.1)


def test_a_step_that_is_not_finite_is_left_out_with_adams_moments():
    network = make_network()
    data = make_data(network, count=128)
    bad = replace(data, advantages=torch.full_like(data.advantages, float("nan")))
    _, engine = make_engines(network)
    config, rate = PPOConfig(minibatch=64, mini_epochs=1), LearningRate(1e-3, 1e-3)

    stats = update(engine, bad, config, rate, torch.Generator().manual_seed(0))
    assert not stats.finite
    assert stats.kl == float("inf")
    for name, value in network.state_dict().items():
        assert torch.equal(engine.network.state_dict()[name], value), name
    assert update(engine, data, config, rate, torch.Generator().manual_seed(0)).finite
    assert all(value.isfinite().all() for value in engine.network.state_dict().values())


def test_a_run_on_it_goes_as_on_the_cpu_and_its_checkpoint_has_adams_moments(tmp_path):
    ppo = PPOConfig(minibatch=64, mini_epochs=2, precision="float32", correction_weight=5.0)
    one, other = make_training(ppo=ppo), make_training(ppo=ppo)
    other.engine = DeviceEngine(other.network, partial(ADAM, lr=ppo.learning_rate), CPU, "float32")
    for epoch in range(5):  # through the stages, and through what a stage change does to the weights
        for training in (one, other):
            training.run_epoch([make_rollout(10 * epoch), make_rollout(10 * epoch + 1)])

    assert one.progress.stage == other.progress.stage == 3
    for name, value in one.network.state_dict().items():
        torch.testing.assert_close(other.network.state_dict()[name], value, rtol=0, atol=5e-5, msg=name)
    ours, theirs = (training.optimizer.state_dict()["state"] for training in (other, one))
    assert ours.keys() == theirs.keys()
    for index, state in theirs.items():
        np.testing.assert_allclose(ours[index]["exp_avg"], state["exp_avg"], atol=1e-4)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_auto_is_the_cpu_and_cuda_is_a_one_line_error():
    assert compute_of(PPOConfig(), "auto").device == CPU
    assert compute_of(PPOConfig(precision="bfloat16", threads=3), "cpu")[1:] == ("bfloat16", 3)
    with pytest.raises(
        ReportedError, match=r"^device cuda, but PyTorch .* finds none here; allowed: cpu, auto$"
    ):
        compute_of(PPOConfig(), "cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_an_update_on_a_gpu_is_the_cpus():
    network = make_network(PRIVILEGED)
    data = make_frames(network)
    config, rate = PPOConfig(minibatch=100, mini_epochs=3), LearningRate(1e-3, 1e-3)
    compute = compute_of(PPOConfig(precision="float32"), "cuda")
    engines = (
        CpuEngine(copy.deepcopy(network), ADAM, 512, "float32"),
        DeviceEngine(copy.deepcopy(network), ADAM, compute.device, compute.precision),
    )
    for engine in engines:
        update(engine, data, config, rate, torch.Generator().manual_seed(0))

    theirs, ours = (engine.network.state_dict() for engine in engines)
    for name, value in theirs.items():
        torch.testing.assert_close(ours[name], value, rtol=0, atol=1e-4, msg=name)
