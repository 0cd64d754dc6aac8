"""A policy without memory learns to keep in its arm what it will be asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from common.policy.actor_critic import NetworkConfig, log_prob
from common.policy.normalizer import Moments, scale_of
from common.policy.weights import new_network
from services.learner.arm import Arm, seen_of
from services.learner.ppo import Dataset, Lesson, PPOConfig, update
from services.learner.through_arm import Motion, replayed

STEPS, ROBOTS, SHOWN = 8, 64, 24  # the first number that isn't the robot's shows, once, what to remember
HOME = torch.tensor([0.0, 0.0, 0.0, 0.57, 0.42, 0.52, 0.0])
MOMENTS = Moments(np.zeros(37), np.full(37, 0.25), 1)


def play(network, arm, seed, noise=0.0):
    """Play rallies of ``STEPS``: a number, +1 or -1, is shown in the first and asked for in the last two.

    Returns:
        A dataset whose frames stand by step, then by robot.
    """
    generator = torch.Generator().manual_seed(seed)
    pos = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.1, 0.0]).repeat(ROBOTS, 1)
    vel = torch.zeros_like(pos)
    number = torch.where(torch.rand(ROBOTS, generator=generator) < 0.5, -1.0, 1.0)
    parts = []
    for t in range(STEPS):
        raw = torch.zeros(ROBOTS, 37)
        raw[:, :SHOWN] = seen_of(pos, vel)
        raw[:, SHOWN] = number * (t == 0)
        obs = (raw / torch.from_numpy(scale_of(MOMENTS)).float()).clamp(-5, 5)
        with torch.no_grad():
            mean, _ = network(obs)
        action = mean + noise * torch.randn(mean.shape, generator=generator)
        told = HOME.repeat(ROBOTS, 1)
        told[:, 6] = 0.2 * number
        asked = torch.full((ROBOTS, 7), float(t >= STEPS - 2))
        ended = torch.full((ROBOTS,), t == STEPS - 1)
        parts.append((obs, action, mean, told - action, asked, torch.cat((pos, vel), 1), ended))
        pos, vel = arm.step(pos, vel, action)
    obs, actions, mean, corrections, says, joints, ended = (
        torch.cat(part) for part in zip(*parts, strict=True)
    )
    log_sigma = network.log_sigma.detach().clone()
    log_mu = log_prob(actions, mean, log_sigma)
    nothing = torch.zeros(len(obs))
    rows = torch.arange(len(obs)).reshape(STEPS, ROBOTS)
    motion = Motion.of(arm, (rows,), joints, actions, ended, MOMENTS)
    return Dataset(obs, actions, log_mu, log_mu, mean, log_sigma, nothing, nothing, corrections, says, motion)


def new(units=(32, 32)):
    torch.manual_seed(0)
    return new_network(NetworkConfig(units=units), home_action=HOME.numpy())


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_played_again_by_the_same_policy_all_is_as_it_was(noise):
    network, arm = new(), Arm()
    torch.nn.init.normal_(network.mean.weight, std=0.3)  # it moves
    data = play(network, arm, 0, noise)

    mean, values = replayed(
        network, data.obs, data.actions, data.mean_prox, data.motion, data.motion.rows[0][:, 10:20]
    )

    frames = data.motion.rows[0][:, 10:20].flatten()
    torch.testing.assert_close(mean, data.mean_prox[frames], atol=3e-4, rtol=0)
    torch.testing.assert_close(values, network(data.obs[frames])[1], atol=3e-4, rtol=0)


def test_played_again_by_another_policy_the_arms_go_where_it_would_have_led_them():
    network, other, arm = new(), new(), Arm()
    with torch.no_grad():
        other.mean.bias += 0.05
    data, wanted = play(network, arm, 0), play(other, arm, 0)

    mean, _ = replayed(other, data.obs, data.actions, data.mean_prox, data.motion, data.motion.rows[0])

    assert (
        wanted.mean_prox - other(data.obs)[0]
    ).abs().max() > 1e-3  # not what it would do in the same place
    torch.testing.assert_close(mean, wanted.mean_prox, atol=1e-4, rtol=0)


def test_a_rally_knows_nothing_of_the_one_before():
    network, arm = new(), Arm()
    data = play(network, arm, 0)
    every = torch.cat((data.motion.rows[0][-1:], data.motion.rows[0][:1]))  # a last step, then a first one
    with torch.no_grad():
        network.mean.bias += 0.3  # leads the arm elsewhere

    mean, _ = replayed(network, data.obs, data.actions, data.mean_prox, data.motion, every)

    torch.testing.assert_close(mean[ROBOTS:], network(data.obs[every[1]])[0])


def test_batches_are_whole_columns_and_take_every_frame_once():
    data = play(new(), Arm(), 0)
    batches = data.motion.batches(10 * STEPS, torch.Generator().manual_seed(0))

    assert {batch.shape[1] for batch in batches} == {10, 4}
    assert all((batch[1:] - batch[:-1] == ROBOTS).all() for batch in batches)
    np.testing.assert_array_equal(
        np.sort(torch.cat([batch.flatten() for batch in batches])), np.arange(STEPS * ROBOTS)
    )


def taught(through_arm):
    """Return the mean square of what a pupil is told to do otherwise in a rally's last steps, over its last lessons."""
    network, arm = new(), Arm()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    config = PPOConfig(minibatch=STEPS * ROBOTS // 2, mini_epochs=2, precision="float32")
    missed = []
    for epoch in range(50):
        data = play(network, arm, epoch, noise=0.1)  # drowns what an arm tells by chance
        missed.append(
            float((data.corrections[:, 6].square() * data.says[:, 6]).sum() / data.says[:, 6].sum()) - 0.1**2
        )
        data = data if through_arm else replace(data, motion=None)
        generator = torch.Generator().manual_seed(epoch)
        update(network, optimizer, data, config, 3e-3, 3e-3, generator, lesson=Lesson.TEACHER)
    return np.mean(missed[-10:])


def test_what_was_shown_once_is_told_later_only_by_who_learns_through_the_arm():
    guessed = 0.2**2  # always in between

    assert taught(through_arm=False) > 0.8 * guessed
    assert taught(through_arm=True) < 0.5 * guessed
