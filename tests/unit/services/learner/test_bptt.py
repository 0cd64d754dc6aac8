"""A policy without memory learns to remember a number in its arm."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from common.policy.actor_critic import NetworkConfig, log_prob
from common.policy.normalizer import Moments, scale_of
from common.policy.weights import new_network
from services.learner.bptt import ArmRollout, replayed
from services.learner.differentiable_arm import ArmModel, robot_observation
from services.learner.ppo import Dataset, LearningRate, PPOConfig, UpdateMode, update

STEPS, ROBOTS, SHOWN = 8, 64, 24  # the first number that isn't the robot's is shown once, to remember
HOME = torch.tensor([0.0, 0.0, 0.0, 0.57, 0.42, 0.52, 0.0])
MOMENTS = Moments(np.zeros(37), np.full(37, 0.25), 1)


def play(network, arm, seed, noise=0.0):
    """Play rallies of ``STEPS``: a number, +1 or -1, is shown in the first step and is the target in the last two.

    Returns:
        A dataset whose frames are in order of step, then of robot.
    """
    generator = torch.Generator().manual_seed(seed)
    pos = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0]).repeat(ROBOTS, 1)
    vel = torch.zeros_like(pos)
    number = torch.where(torch.rand(ROBOTS, generator=generator) < 0.5, -1.0, 1.0)
    parts = []
    for t in range(STEPS):
        raw = torch.zeros(ROBOTS, 37)
        raw[:, :SHOWN] = robot_observation(pos, vel)
        raw[:, SHOWN] = number * (t == 0)
        obs = (raw / torch.from_numpy(scale_of(MOMENTS)).float()).clamp(-5, 5)
        with torch.no_grad():
            mean, _ = network(obs)
        action = mean + noise * torch.randn(mean.shape, generator=generator)
        target = HOME.repeat(ROBOTS, 1)
        target[:, 6] = 0.2 * number
        weight = torch.full((ROBOTS, 7), float(t >= STEPS - 2))
        ended = torch.full((ROBOTS,), t == STEPS - 1)
        parts.append((obs, action, mean, target - action, weight, torch.cat((pos, vel), 1), ended))
        pos, vel = arm.step(pos, vel, action)
    obs, actions, mean, corrections, weights, joints, ended = (
        torch.cat(part) for part in zip(*parts, strict=True)
    )
    log_std = network.log_std.detach().clone()
    log_mu = log_prob(actions, mean, log_std)
    nothing = torch.zeros(len(obs))
    rows = torch.arange(len(obs)).reshape(STEPS, ROBOTS)
    motion = ArmRollout.of(arm, (rows,), joints, actions, ended, MOMENTS)
    return Dataset(
        obs, actions, log_mu, log_mu, mean, log_std, nothing, nothing, corrections, weights, motion
    )


def new(units=(32, 32)):
    torch.manual_seed(0)
    return new_network(NetworkConfig(units=units), home_action=HOME.numpy())


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_replay_by_the_same_policy_gives_the_recorded_actions(noise):
    network, arm = new(), ArmModel()
    torch.nn.init.normal_(network.mean.weight, std=0.3)  # it moves
    data = play(network, arm, 0, noise)

    mean, values = replayed(
        network, data.obs, data.actions, data.mean_prox, data.motion, data.motion.rows[0][:, 10:20]
    )

    frames = data.motion.rows[0][:, 10:20].flatten()
    torch.testing.assert_close(mean, data.mean_prox[frames], atol=3e-4, rtol=0)
    torch.testing.assert_close(values, network(data.obs[frames])[1], atol=3e-4, rtol=0)


def test_a_replay_by_another_policy_moves_the_arms_as_that_policy_would():
    network, other, arm = new(), new(), ArmModel()
    with torch.no_grad():
        other.mean.bias += 0.05
    data, wanted = play(network, arm, 0), play(other, arm, 0)

    mean, _ = replayed(other, data.obs, data.actions, data.mean_prox, data.motion, data.motion.rows[0])

    assert (wanted.mean_prox - other(data.obs)[0]).abs().max() > 1e-3  # not its action in the recorded place
    torch.testing.assert_close(mean, wanted.mean_prox, atol=1e-4, rtol=0)


def test_a_rally_does_not_depend_on_the_one_before():
    network, arm = new(), ArmModel()
    data = play(network, arm, 0)
    every = torch.cat((data.motion.rows[0][-1:], data.motion.rows[0][:1]))  # a last step, then a first one
    with torch.no_grad():
        network.mean.bias += 0.3  # moves the arm elsewhere

    mean, _ = replayed(network, data.obs, data.actions, data.mean_prox, data.motion, every)

    torch.testing.assert_close(mean[ROBOTS:], network(data.obs[every[1]])[0])


def test_batches_are_whole_columns_and_hold_every_frame_once():
    data = play(new(), ArmModel(), 0)
    batches = data.motion.batches(10 * STEPS, torch.Generator().manual_seed(0))

    assert {batch.shape[1] for batch in batches} == {10, 4}
    assert all((batch[1:] - batch[:-1] == ROBOTS).all() for batch in batches)
    np.testing.assert_array_equal(
        np.sort(torch.cat([batch.flatten() for batch in batches])), np.arange(STEPS * ROBOTS)
    )


def trained(bptt):
    """Return the mean square of a student's corrections in a rally's last steps, over its last updates."""
    network, arm = new(), ArmModel()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    config = PPOConfig(minibatch=STEPS * ROBOTS // 2, mini_epochs=2, precision="float32")
    missed = []
    for epoch in range(50):
        data = play(network, arm, epoch, noise=0.1)  # hides what an arm shows by chance
        missed.append(
            float(
                (data.corrections[:, 6].square() * data.correction_weights[:, 6]).sum()
                / data.correction_weights[:, 6].sum()
            )
            - 0.1**2
        )
        data = data if bptt else replace(data, motion=None)
        generator = torch.Generator().manual_seed(epoch)
        update(network, optimizer, data, config, LearningRate(3e-3, 3e-3), generator, mode=UpdateMode.DISTILL)
    return np.mean(missed[-10:])


def test_a_policy_remembers_a_number_only_with_gradients_through_the_arm():
    guessed = 0.2**2  # error of the action halfway between both targets

    assert trained(bptt=False) > 0.8 * guessed
    assert trained(bptt=True) < 0.5 * guessed
