import dataclasses
import shutil

import numpy as np
import pytest
import torch

from common.comms.messages import PolicySnapshot
from common.env.rally_env import Launches
from common.env.robot import home_action
from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError, contract_hash
from common.policy.folder import load_policy
from common.policy.network_pass import native_precision
from common.policy.normalizer import normalize
from common.policy.weights import new_network, observation_moments, pack
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import draw_rallies
from common.task.observation import critic_layout, offsets, policy_layout, size
from services.actor.player import Player
from tests.unit.env.teachers import write_teacher

ENVS, HORIZON = 6, 40
NETWORK = NetworkConfig(units=(16, 8))
OBSERVATION = TaskConfig().observation
SIZE = size(critic_layout(OBSERVATION))
CONFIG = TaskConfig(time_limit_s=0.5)  # some rallies end in time, some are truncated


class Dealer:
    """Gives a generator's rallies, every third one marked as not validated."""

    def __init__(self):
        self.block = draw_rallies(1600, seed=5)
        self.dealt = 0

    def take(self, rows):
        rows = self.dealt + np.arange(rows.size)
        self.dealt += rows.size
        return Launches(self.block.launches[rows], self.block.seeds[rows], rows % 3 > 0)


def make_player(seed=1):
    return Player(CONFIG, ExperienceConfig(), NETWORK, Dealer(), ENVS, HORIZON, seed)


def make_snapshot(player, seed=2, **changes):
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    snapshot = PolicySnapshot(
        run="r",
        generation=4,
        version=7,
        stage_number=1,
        stage=2,
        epoch=7,
        frames=1000,
        contract_hash=contract_hash(CONFIG, NETWORK),
        training_hash=player.training_hash,
        weights=pack(new_network(NETWORK, OBSERVATION)),
        obs_mean=rng.normal(size=SIZE) * 0.1,
        obs_var=rng.uniform(0.5, 2.0, SIZE),
        obs_count=100,
    )
    return dataclasses.replace(snapshot, **changes)


def played(seed=1, sequence=3):
    player = make_player(seed)
    player.adopt(make_snapshot(player))
    return player, player.play("a", 9, sequence)


@pytest.fixture(scope="module")
def block():
    return played()[1]


def test_a_block_names_its_actor_and_policy(block):
    stamps = ("run", "generation", "version", "stage_number", "actor", "incarnation", "sequence")

    assert [getattr(block, name) for name in stamps] == ["r", 4, 7, 1, "a", 9, 3]
    assert block.obs.shape == (HORIZON, ENVS, SIZE)
    assert block.fault() == ""


def test_its_log_mu_is_that_of_the_policy_at_its_observations(block):
    player = make_player()
    snapshot = make_snapshot(player)
    player.adopt(snapshot)
    network = player._network
    moments = observation_moments(
        snapshot.obs_mean, snapshot.obs_var, snapshot.obs_count, critic_layout(OBSERVATION)
    )
    is_bfloat16 = native_precision() == "bfloat16"
    with torch.no_grad():
        with torch.autocast("cpu", torch.bfloat16, enabled=is_bfloat16):
            mean, _ = network(torch.from_numpy(normalize(block.obs.reshape(-1, SIZE), moments)))
        normal = torch.distributions.Normal(mean.float(), network.log_std.exp())
        log_mu = normal.log_prob(torch.from_numpy(block.actions.reshape(-1, 7))).sum(-1)

    # sums in another order; now and then they round to another bfloat16: 0.4 % of a mean, in deviations of 0.2
    np.testing.assert_allclose(block.log_mu.reshape(-1), log_mu.numpy(), atol=0.1 if is_bfloat16 else 2e-4)
    assert np.median(np.abs(block.log_mu.reshape(-1) - log_mu.numpy())) < 1e-3


def test_only_the_policy_acts_and_it_observes_only_its_own_part(block):
    player = make_player()
    snapshot = make_snapshot(player)
    hidden = np.arange(SIZE) >= player._network.obs_size  # the critic's additional numbers
    assert hidden.any()
    player.adopt(dataclasses.replace(snapshot, obs_mean=np.where(hidden, 1e3, snapshot.obs_mean)))
    player._network.value = player._network.judge = None

    np.testing.assert_array_equal(player.play("a", 9, 3).actions, block.actions)


def test_a_truncated_rally_keeps_its_real_last_observation_at_its_step(block):
    cut = np.flatnonzero(block.truncated)

    assert cut.size > 0
    np.testing.assert_array_equal(block.final_index, cut)
    assert block.final_obs.shape == (cut.size, SIZE)
    following = np.concatenate((block.obs[1:], block.last_obs[None])).reshape(-1, SIZE)[cut]
    # after it another rally begins: its first observation is not the last of this one
    assert (np.abs(block.final_obs - following).max(axis=1) > 1e-3).all()
    assert not (block.terminated & block.truncated).any()


def test_episodes_list_every_rally_that_ended(block):
    ended = int((block.terminated | block.truncated).sum())

    assert len(block.episodes.outcome) >= ended > 0
    assert 0 < block.episodes.unvalidated.sum() < len(block.episodes.outcome)
    np.testing.assert_allclose(block.reward_terms.sum(), block.rewards.sum(dtype=np.float64), rtol=1e-4)


def test_the_same_seed_and_number_play_the_same_block_bit_for_bit_and_others_another(block):
    again, other_number, other_seed = played()[1], played(sequence=4)[1], played(seed=2)[1]

    for field in dataclasses.fields(block):
        if field.name not in ("seconds", "episodes"):
            np.testing.assert_array_equal(getattr(block, field.name), getattr(again, field.name), field.name)
    assert not np.array_equal(block.actions, other_number.actions)
    assert not np.array_equal(block.actions, other_seed.actions)


def test_the_next_block_continues_where_the_last_one_ended():
    player, first = played()

    second = player.play("a", 9, 4)

    np.testing.assert_array_equal(second.obs[0], first.last_obs)


def test_a_policy_of_another_task_or_with_unusable_weights_is_refused_and_the_old_one_kept():
    player, _ = played()
    before = {name: value.clone() for name, value in player._network.state_dict().items()}
    nan = new_network(NETWORK, OBSERVATION)
    with torch.no_grad():
        next(nan.parameters()).fill_(float("nan"))

    for changes, message in (
        ({"training_hash": "other"}, "start both with the same"),
        ({"weights": b"rubbish"}, "not readable as safetensors"),
        ({"weights": pack(nan)}, "are not finite"),
        ({"weights": pack(new_network(NetworkConfig(units=(16, 9)), OBSERVATION))}, "have shape"),
        ({"obs_mean": np.zeros(3), "obs_var": np.ones(3)}, r"shapes \(3,\)"),
    ):
        with pytest.raises(PolicyError, match=message):
            player.adopt(make_snapshot(player, version=8, **changes))

    assert player.snapshot is not None
    assert player.snapshot.version == 7
    for name, value in player._network.state_dict().items():
        assert torch.equal(value, before[name])


def struck_block(stage=3, **experience):
    """Return a block of 512 robots near home, some of which the ball hits."""
    player = Player(CONFIG, ExperienceConfig(**experience), NETWORK, Dealer(), 512, HORIZON, 1)
    torch.manual_seed(0)
    network = new_network(NETWORK, OBSERVATION, player.env.home_action)
    with torch.no_grad():
        network.mean.bias[0] = 1.2  # the first joint's action is clipped
    player.adopt(make_snapshot(player, stage=stage, weights=pack(network)))
    return player.play("a", 9, 3)


def shows_a_hit(block):
    """Return which observations of a block show that the ball has been hit (T, B)."""
    return block.obs[..., offsets(critic_layout(OBSERVATION))["trajectory_state"].start] > 0.0


def test_after_its_hit_a_robot_is_led_home_in_small_steps_whatever_was_clipped():
    block = struck_block(end_at_hit_share=0.0)
    has_hit = shows_a_hit(block)
    led = block.corrections[has_hit]
    home = home_action("rails")

    assert has_hit.sum() > 20
    np.testing.assert_allclose(np.linalg.norm(led, axis=1), 0.02, rtol=1e-5)
    # the first joint's mean is 1.2 beyond home, and the others' are near it
    assert (led[:, 0] < -0.015).all()
    assert home[0] < 1.0
    np.testing.assert_array_equal(block.corrections[~has_hit], 0.0)  # before, rewards alone say what to do


@pytest.mark.parametrize(("stage", "changes"), [(1, {}), (2, {}), (3, {"leads_home": False})])
def test_outside_stage_3_and_where_it_is_off_no_robot_is_led_home(stage, changes):
    block = struck_block(stage, **changes)

    assert block.episodes.caught.any()
    assert block.corrections.shape == block.actions.shape
    np.testing.assert_array_equal(block.corrections, 0.0)


@pytest.mark.parametrize("version", [6, 7])
def test_during_distillation_all_corrections_are_the_teachers_and_lead_home_after_a_hit(tmp_path, version):
    teacher = write_teacher(tmp_path / "t").model_copy(update={"epochs": 7})
    experience = ExperienceConfig(teacher=teacher)
    player = Player(CONFIG, experience, NETWORK, Dealer(), 64, HORIZON, 1)
    torch.manual_seed(0)
    home = pack(new_network(NETWORK, OBSERVATION, player.env.home_action))
    player.adopt(make_snapshot(player, stage=3, version=version, weights=home))
    block = player.play("a", 9, 3)

    assert block.episodes.caught.any()
    if version < 7:
        seen = block.obs[..., : size(policy_layout(OBSERVATION))]
        advised = np.array([load_policy(tmp_path / "t").act(obs).clip(-1, 1) for obs in seen])
        advised[shows_a_hit(block)] = player.env.home_action
        assert shows_a_hit(block).any()
        np.testing.assert_allclose(block.actions + block.corrections, advised, atol=1e-6)
    else:
        alone = Player(CONFIG, ExperienceConfig(), NETWORK, Dealer(), 64, HORIZON, 1)
        alone.adopt(make_snapshot(alone, stage=3, version=version, weights=home))
        untaught = alone.play("a", 9, 3)
        assert (untaught.corrections != 0.0).any()
        np.testing.assert_array_equal(block.corrections, untaught.corrections)


def test_a_teacher_that_is_gone_is_missed_only_while_it_teaches(tmp_path):
    teacher = write_teacher(tmp_path / "t").model_copy(update={"epochs": 7})
    shutil.rmtree(tmp_path / "t")
    player = Player(CONFIG, ExperienceConfig(teacher=teacher), NETWORK, Dealer(), 4, HORIZON, 1)
    weights = pack(new_network(NETWORK, OBSERVATION, player.env.home_action))
    player.adopt(make_snapshot(player, version=6, weights=weights))
    with pytest.raises(PolicyError, match=f"no policy .*{tmp_path / 't'}"):
        player.play("a", 9, 3)
    player.adopt(make_snapshot(player, version=7, weights=weights))

    assert player.play("a", 9, 3).version == 7


def test_play_needs_a_policy_first():
    with pytest.raises(RuntimeError, match="there is no policy yet"):
        make_player().play("a", 1, 0)
