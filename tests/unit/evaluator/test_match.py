import numpy as np
import pytest

from common.env.rally_env import EnvConfig, RallyEnv
from common.policy.actor_critic import NetworkConfig
from common.policy.normalizer import Moments
from common.policy.weights import ACTION_CONTRACT, Contract, Policy, new_network, observation_contract
from common.rally.launch import Purpose, draw_rallies
from common.rally.observation import critic_layout, size
from services.evaluator.match import FixedRallies, evaluation_rallies, play_match

NETWORK = NetworkConfig(units=(16, 8))
OBSERVATION = EnvConfig().observation


def make_policy():
    contract = Contract(
        observation=observation_contract(OBSERVATION),
        observation_options=OBSERVATION,
        action=ACTION_CONTRACT,
        network=NETWORK,
        control_rate_hz=50,
        robot="rails",
        launch="paper",
        noise="standard",
        run="r",
        generation=1,
        version=1,
        stage=3,
        frames=1,
    )
    return Policy(
        new_network(NETWORK, OBSERVATION), Moments.initial(size(critic_layout(OBSERVATION))), contract
    )


def test_rallies_are_dealt_once_each_in_order_and_then_filler_that_counts_for_nothing():
    rallies = draw_rallies(5, seed=1, purpose=Purpose.EVALUATION)
    filler = draw_rallies(2, seed=1, purpose=Purpose.FALLBACK)
    source = FixedRallies(rallies, filler)

    dealt = [source.take(count) for count in (2, 2, 4, 1)]

    seeds = np.concatenate([d.seeds for d in dealt])
    np.testing.assert_array_equal(seeds[:5], rallies.seeds)
    np.testing.assert_array_equal(seeds[5:], filler.seeds[[0, 1, 0, 1]])
    assert np.concatenate([d.validated for d in dealt]).tolist() == [True] * 5 + [False] * 4


def test_a_match_rates_every_rally_of_the_set_exactly_once():
    policy, rallies = make_policy(), evaluation_rallies(50, "paper", "standard", seed=4)

    played = play_match(policy, rallies, EnvConfig(), envs=12)

    assert sorted(played.seeds.tolist()) == sorted(rallies.seeds.tolist())


def test_the_same_seed_plays_the_same_match_with_any_number_of_environments():
    policy, rallies = make_policy(), evaluation_rallies(30, "paper", "off", seed=4)
    # robots that start at home: how the last stroke left one depends on which environment a rally meets
    config = EnvConfig(noise="off", carry_over=0.0)

    def result(envs):
        played = play_match(policy, rallies, config, envs=envs)
        order = np.argsort(played.seeds)
        return played.outcomes[order], played.returns[order]

    one, again, wider = result(8), result(8), result(30)

    for other in (again, wider):
        np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], again[1])


def test_nobody_trains_on_the_evaluations_rallies():
    fixed = evaluation_rallies(500, "paper", "standard", seed=0)
    trained = [
        draw_rallies(500, seed=0, shard=shard, block=block) for shard in range(2) for block in range(2)
    ]

    np.testing.assert_array_equal(fixed.seeds, evaluation_rallies(500, "paper", "standard", seed=0).seeds)
    assert not set(fixed.seeds.tolist()) & {seed for block in trained for seed in block.seeds.tolist()}
    assert not np.array_equal(fixed.seeds, evaluation_rallies(500, "paper", "standard", seed=1).seeds)


def test_a_match_can_be_broken_off_between_two_steps():
    def breathe():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        play_match(make_policy(), evaluation_rallies(5, "paper", "off", seed=4), EnvConfig(), breathe=breathe)


@pytest.mark.timeout(60)
def test_a_fault_of_the_simulation_costs_one_rally_and_the_match_still_ends(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log file of its warnings
    policy, rallies = make_policy(), evaluation_rallies(6, "paper", "standard", 0)
    broken = []
    start = RallyEnv.reset

    def reset_and_break(env):
        obs = start(env)
        env.robot.joint_vel[1] = np.nan
        broken.append(env)
        return obs

    monkeypatch.setattr(RallyEnv, "reset", reset_and_break)
    played = play_match(policy, rallies, EnvConfig(), envs=3)

    assert len(broken) == 1
    assert len(played.seeds) == 5
    assert set(played.seeds) < set(rallies.seeds)
