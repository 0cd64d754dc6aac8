"""A group of learners trains as one learner that has all the rollouts."""

import multiprocessing
from multiprocessing.connection import Connection

import numpy as np
import pytest
import torch

from common.policy.config import NetworkConfig
from common.policy.weights import new_network
from deploy.prepare import free_port
from services.learner.config import CurriculumConfig, PPOConfig
from services.learner.group import ALONE, Group, GroupError, join
from services.learner.ppo import Share, minibatches
from services.learner.training import Training
from tests.unit.services.learner.rollouts import make_rollout
from tests.unit.services.learner.test_ppo import make_data
from tests.unit.services.learner.test_training import make_training

ROLLOUTS = 4
EPOCHS = 3
# A stage change on the way: its first epochs train the critic alone
CURRICULUM = CurriculumConfig(stage_1=1, stage_2=0, stage_3=50_000)


def trained(group: Group, ppo: PPOConfig) -> Training:
    """Return a training after three epochs, of which this rank has had its share of the rollouts.

    The first rank has all of the second dataset.
    """
    training = make_training(ppo=ppo, curriculum=CURRICULUM)
    training.group = group
    each = ROLLOUTS // group.size
    for epoch in range(EPOCHS):
        # Rollouts of different sizes: a rank's share is not a fixed part of the dataset
        rollouts = [make_rollout(seed=10 * epoch + k, envs=8 + 4 * k) for k in range(ROLLOUTS)]
        mine = rollouts[each * group.rank : each * (group.rank + 1)]
        if epoch == 1:
            mine = [] if group.rank else rollouts
        training.run_epoch(mine)
    return training


def outcome(training: Training) -> dict[str, np.ndarray]:
    """Return all that an epoch changes."""
    stats = training.progress
    arrays = {name: value.detach().numpy() for name, value in training.network.state_dict().items()}
    return arrays | {
        "obs mean": training.obs_moments.mean,
        "obs var": training.obs_moments.var,
        "value mean": training.value_moments.mean,
        "progress": np.array([stats.version, stats.frames, stats.stage, stats.epochs_in_stage]),
        "learning rate": np.array(stats.learning_rate),
        "catch rate": np.array(stats.catch_rate),
    }


def exchanged(group: Group) -> None:
    """Check what every rank gets of the others."""
    ticks = []
    told = group.gathered(
        np.arange(group.rank), np.full((2, 3), group.rank, np.float32), on_tick=lambda: ticks.append(0)
    )
    for rank, (numbers, block) in enumerate(told):
        np.testing.assert_array_equal(numbers, np.arange(rank))
        np.testing.assert_array_equal(block, np.full((2, 3), rank, np.float32))
    long = np.arange(group.rank * 300_000.0)  # in pieces, where memory is shared; of the first rank nothing
    for rank, (numbers,) in enumerate(group.gathered(long)):
        np.testing.assert_array_equal(numbers, np.arange(rank * 300_000.0))
    texts = [b"", bytes(range(256)), b"x" * group.rank][: group.rank + 1]
    assert group.gathered_bytes(texts)[-1] == [b"", bytes(range(256)), b"x" * (group.size - 1)][: group.size]
    assert group.gathered_bytes([])[0] == []
    assert group.of_leader(b"of the leader" if group.leads else b"of another") == b"of the leader"


def summed(group: Group) -> None:
    """Check that sums are those of all ranks: of few numbers, and of so many that they go in pieces and shares."""
    for count in (1, 5, 300_001):
        numbers = np.arange(count) + 1000.0 * group.rank
        group.add(numbers)
        expected = group.size * np.arange(count) + 1000.0 * sum(range(group.size))
        np.testing.assert_array_equal(numbers, expected)
        tensor = torch.arange(float(count)) + 1000.0 * group.rank
        group.add_tensor(tensor)
        np.testing.assert_array_equal(tensor.numpy(), expected)


def rank_main(rank: int, size: int, where: dict[str, str], ppo: PPOConfig, results: Connection) -> None:
    import os

    os.environ |= where  # torch reads its part from there
    group = join({"RANK": str(rank), "WORLD_SIZE": str(size), **where})
    exchanged(group)
    summed(group)
    results.send(outcome(trained(group, ppo)))
    group.leave()


def train_together(size: int, where: dict[str, str], ppo: PPOConfig) -> list[dict[str, np.ndarray]]:
    """Return every rank's outcome."""
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe(duplex=False) for _ in range(size)]
    ranks = [
        context.Process(target=rank_main, args=(rank, size, where, ppo, pipes[rank][1]))
        for rank in range(size)
    ]
    for rank in ranks:
        rank.start()
    found = [receiver.recv() if receiver.poll(120) else {} for receiver, _ in pipes]
    for rank in ranks:
        rank.join(30)
    return found


@pytest.mark.parametrize(
    ("size", "minibatch", "links"), [(2, 64, "memory"), (2, 64, "torch"), (4, 32, "memory")]
)
def test_ranks_reach_the_parameters_of_one_learner(size, minibatch, links, tmp_path):
    """Of four ranks with minibatches of 32 some have no frame in a minibatch, and the others train it."""
    ppo = PPOConfig(
        minibatch=minibatch, mini_epochs=2, precision="float32", correction_weight=5.0, refit_frames=1
    )
    where = (
        {"GROUP_FILE": str(tmp_path / "group")}
        if links == "memory"
        else {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    )
    alone = outcome(trained(ALONE, ppo))
    ranks = train_together(size, where, ppo)

    for rank in ranks:
        assert rank.keys() == alone.keys()
        for name, expected in alone.items():
            np.testing.assert_allclose(rank[name], expected, rtol=0, atol=1e-6, err_msg=name)
            np.testing.assert_array_equal(rank[name], ranks[0][name], err_msg=name)
    assert not list(tmp_path.iterdir())


def test_a_pass_over_a_group_has_minibatches_without_a_frame_of_a_rank():
    """The smallest of four shares has 128 of 896 frames: a minibatch of 32 has none of them about once in 140."""
    data = make_data(new_network(NetworkConfig(units=(16,))), 128)
    share = Share(Group(0, 4), 0, 896, 1.0, False)
    generator = torch.Generator().manual_seed(0)
    counts = [len(part) for _ in range(20) for part, _ in minibatches(data, 32, generator, share)]

    assert sum(counts) == 20 * 128
    assert min(counts) == 0


def test_without_torchrun_a_learner_is_alone():
    assert join({}) == ALONE
    assert join({"RANK": "0", "WORLD_SIZE": "1"}) == ALONE


@pytest.mark.parametrize("environment", [{"WORLD_SIZE": "2"}, {"WORLD_SIZE": "two", "RANK": "0"}])
def test_an_incomplete_environment_is_refused(environment):
    with pytest.raises(GroupError, match="allowed: two whole numbers, as torchrun sets them"):
        join(environment)


def test_alone_nothing_is_summed_or_copied():
    values, array = np.ones(3), np.arange(4.0)
    ALONE.add(values)

    assert values.tolist() == [1.0, 1.0, 1.0]
    assert ALONE.gathered(array)[0][0] is array
    assert ALONE.of_leader(b"own") == b"own"
