"""One plain gradient step of an update: what each weight and limit of ``PPOConfig`` does to the parameters.

SGD moves parameters by -lr times their gradient, so a step shows the gradient itself.
"""

from dataclasses import replace

import pytest
import torch

from common.policy.actor_critic import ActorCritic
from common.policy.config import NetworkConfig
from common.policy.weights import new_network
from services.learner.config import PPOConfig
from services.learner.minibatches import Dataset, minibatches, whole
from services.learner.ppo import LearningRate, UpdateMode
from tests.unit.services.learner.test_ppo import make_data, update

RATE = 1e-3


def stepped(
    data_of=lambda data: data, mode=UpdateMode.PPO, **settings
) -> tuple[dict[str, torch.Tensor], float]:
    """Return the parameters' changes divided by -RATE, and the gradient's norm before it was limited."""
    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(16,)))
    before = {name: value.detach().clone() for name, value in network.named_parameters()}
    data: Dataset = data_of(make_data(network, count=64))
    config = PPOConfig(minibatch=64, mini_epochs=1, precision="float32", **settings)
    optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
    stats = update(
        network,
        optimizer,
        data,
        config,
        LearningRate(RATE, RATE),
        torch.Generator().manual_seed(0),
        mode=mode,
    )
    changes = {name: (before[name] - value.detach()) / RATE for name, value in network.named_parameters()}
    return changes, stats.gradient_norm


def norm_of(changes: dict[str, torch.Tensor]) -> float:
    return float(torch.sqrt(sum(change.square().sum() for change in changes.values())))


def part(changes: dict[str, torch.Tensor], start: str) -> float:
    return norm_of({name: change for name, change in changes.items() if name.startswith(start)})


def far_from_zero(data: Dataset) -> Dataset:
    return replace(data, advantages=1000.0 * data.advantages)


def test_a_long_gradient_is_shortened_to_the_limit_and_reported_as_it_was():
    changes, norm = stepped(far_from_zero, gradient_norm=0.5)

    assert norm > 10.0
    assert norm_of(changes) == pytest.approx(0.5, rel=1e-2)


def test_a_short_gradient_is_taken_as_it_is():
    changes, norm = stepped(gradient_norm=1e6)

    assert norm_of(changes) == pytest.approx(norm, rel=1e-2)


@pytest.mark.parametrize("weight", [0.0, 1.0, 4.0])
def test_the_critics_gradient_is_in_proportion_to_the_value_weight(weight):
    one, some = (stepped(gradient_norm=1e6, value_weight=w)[0] for w in (1.0, weight))

    assert part(some, "value.") == pytest.approx(weight * part(one, "value."), rel=1e-2, abs=1e-6)


def without_advantage(data: Dataset) -> Dataset:
    return replace(data, advantages=torch.zeros_like(data.advantages))


def test_an_entropy_bonus_widens_the_action_noise():
    """Entropy is the sum of log sigma and a constant: its gradient by each log sigma is 1."""
    changes, _ = stepped(without_advantage, gradient_norm=1e6, entropy_weight=0.5)

    torch.testing.assert_close(changes["log_std"], torch.full((7,), -0.5), rtol=1e-2, atol=1e-4)


def test_mean_actions_beyond_the_joints_range_are_pulled_back_by_the_bound_weight():
    """With a bias of 3 in every action the excess is about 2, and the gradient of its square by the bias is 4."""

    def shifted(network: ActorCritic) -> None:
        with torch.no_grad():
            network.mean.weight.zero_()
            network.mean.bias.fill_(3.0)

    torch.manual_seed(0)
    network = new_network(NetworkConfig(units=(16,)))
    shifted(network)
    data = without_advantage(make_data(network, count=64))
    optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
    config = PPOConfig(minibatch=64, mini_epochs=1, precision="float32", gradient_norm=1e6, bound_weight=0.25)
    update(network, optimizer, data, config, LearningRate(RATE, RATE), torch.Generator().manual_seed(0))

    torch.testing.assert_close(network.mean.bias.detach(), torch.full((7,), 3.0 - RATE), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "size", "expected"),
    [(100, 50, [50, 50]), (90, 40, [40, 40]), (100, 40, [40, 40, 20]), (30, 64, [30])],
)
def test_a_remainder_smaller_than_half_a_minibatch_is_left_out(frames, size, expected):
    data = make_data(new_network(NetworkConfig(units=(16,))), frames)
    batches = [batch for batch, _ in minibatches(data, size, torch.Generator().manual_seed(0), whole(data))]

    assert [len(batch) for batch in batches] == expected


def test_a_pass_takes_every_frame_once_with_all_that_belongs_to_it():
    data = make_data(new_network(NetworkConfig(units=(16,))), 96)
    number = torch.arange(96.0)
    numbered = replace(data, advantages=number, value_targets=-number)
    batches = [batch for batch, _ in minibatches(numbered, 32, torch.Generator().manual_seed(0), whole(data))]
    order = torch.cat([batch.advantages for batch in batches])

    assert not torch.equal(order, number)
    assert torch.equal(order.sort().values, number)
    for batch in batches:
        rows = batch.advantages.long()
        assert torch.equal(batch.value_targets, -batch.advantages)
        for name in ("obs", "actions", "log_mu", "log_prox", "mean_prox", "corrections"):
            assert torch.equal(getattr(batch, name), getattr(data, name)[rows]), name
