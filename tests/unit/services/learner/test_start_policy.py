"""Training that starts from a trained policy."""

import numpy as np
import pytest
import torch

from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError, contract_of
from common.policy.folder import Policy, load_policy, save_policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.experience import ExperienceConfig
from common.task.observation import critic_layout, policy_layout, size
from services.learner.__main__ import settings, settings_for_others
from services.learner.config import LearnerConfig
from services.learner.training import new_training
from tests.unit.services.learner.rollouts import ROLLOUT_FRAMES, make_rollout

NETWORK = NetworkConfig(units=(16, 8))
FLAGS = (
    *("--network.units", "16,8", "--curriculum.first-stage", "3", "--experience.leads-home", "false"),
    *("--ppo.minibatch", "64", "--ppo.mini-epochs", "2", "--ppo.precision", "float32"),
)


@pytest.fixture
def saved(tmp_path):
    """Return the folder of a policy with weights and moments unlike those of a new one."""
    config = settings(FLAGS)
    rng = np.random.default_rng(5)
    network = new_network(NETWORK, config.task.observation, np.zeros(7, np.float32))
    with torch.no_grad():
        for parameter in network.policy_parameters():
            parameter.add_(torch.from_numpy(0.1 * rng.standard_normal(tuple(parameter.shape))))
    own = size(critic_layout(config.task.observation))
    moments = Moments(rng.normal(size=own), rng.uniform(0.5, 2.0, own), 1234)
    contract = contract_of(
        *(config.task, ExperienceConfig(), NETWORK), run="r", generation=1, version=9, stage=3, frames=900
    )
    save_policy(tmp_path / "policy", network, moments, contract)
    return tmp_path / "policy"


def started(folder, *more):
    return new_training(settings((*FLAGS, "--start-policy", str(folder), *more)))


def actions(network, moments, obs):
    return Policy(network, moments, None).act(obs)


def observations():
    return np.random.default_rng(1).normal(size=(200, 54)).astype(np.float32)


def test_it_acts_as_the_policy_from_the_first_frame_on(saved):
    policy, training = load_policy(saved), started(saved)

    expected = policy.act(observations())
    for network in (training.network, training.average):
        np.testing.assert_array_equal(actions(network, training.obs_moments, observations()), expected)
    torch.testing.assert_close(training.network.log_std, policy.network.log_std)
    assert (training.progress.version, training.progress.frames, training.progress.stage) == (0, 0, 3)


def test_while_the_critic_learns_the_moments_change_but_not_what_is_played(saved):
    """A first dataset is all launches, and those after it are not: the moments move for many datasets."""
    training = started(saved)
    before, count = training.obs_moments, training.obs_size
    expected = actions(training.network, before, observations())
    critic = [p.detach().clone() for p in training.network.value.parameters()]

    for epoch in range(4):
        rollout = make_rollout(epoch, obs_size=count)
        rollout.obs[...] = rollout.obs + 0.5 * epoch
        training.run_epoch([rollout])

    assert np.abs(training.obs_moments.mean - before.mean).max() > 0.5
    for network in (training.network, training.average):
        played = actions(network, training.obs_moments, observations())
        # the median, because the one normaliser clips inputs that the other does not
        assert np.median(np.abs(played - expected)) < 1e-5
    assert any(
        not torch.equal(a, b) for a, b in zip(critic, training.network.value.parameters(), strict=True)
    )
    assert training.progress.refitting


def test_the_policy_learns_once_the_critic_has(saved):
    training = started(saved, "--ppo.refit-frames", str(2 * ROLLOUT_FRAMES))
    for epoch in range(2):
        training.run_epoch([make_rollout(epoch, obs_size=training.obs_size)])
    mean = training.network.mean.weight.detach().clone()

    stats = training.run_epoch([make_rollout(2, obs_size=training.obs_size)])

    assert not torch.equal(mean, training.network.mean.weight)
    assert stats.update.learning_rate < 4.6e-5  # from 2e-5, the lower bound, by 1.5 a pass at most


def test_a_policy_that_does_not_fit_is_refused_with_all_that_must_change(saved):
    flags = ("--network.units", "8,8", "--task.observation.spin", "hidden", "--curriculum.first-stage", "1")
    with pytest.raises(PolicyError) as error:
        started(saved, *flags)

    assert str(error.value) == (
        f"start_policy {saved} does not fit this run: network.units 8,8 (allowed: 16,8); "
        "task.observation.spin hidden (allowed: estimated); curriculum.first_stage 1 (allowed: 3 or later)"
    )


def test_a_policy_that_is_not_there_is_refused():
    with pytest.raises(PolicyError, match=r"^no policy 'defualt'; allowed: a policy folder, or one of "):
        started("defualt")


def test_a_resumed_run_does_not_read_it(saved):
    config = settings((*FLAGS, "--start-policy", "gone")).model_copy(update={"resume": True})

    training = new_training(config)

    assert training.has_start_policy  # what it began with still decides how moments are counted
    new = new_training(settings(FLAGS))
    torch.testing.assert_close(
        training.network.mean.bias, new.network.mean.bias
    )  # until its checkpoint is read


def test_no_learner_of_a_resumed_group_reads_it():
    leader = settings((*FLAGS, "--start-policy", "gone")).model_copy(update={"resume": True})
    config = LearnerConfig.model_validate_json(settings_for_others(leader, "tcp/hall:7447"))

    assert (config.resume, config.endpoint) == (True, "tcp/hall:7447")
    assert new_training(config).has_start_policy


def test_a_student_may_start_from_a_policy_too(saved):
    """Such as its teacher: it is led home after its hits, and plays as before otherwise."""
    training = new_training(
        settings((*FLAGS, "--start-policy", str(saved), "--experience.teacher.policy", "mild"))
    )

    assert training.is_distilling
    theirs = load_policy(saved).network.mean.bias
    torch.testing.assert_close(training.network.mean.bias, theirs)


def test_the_layout_of_these_tests_is_the_defaults():
    assert size(policy_layout(settings(FLAGS).task.observation)) == 54
