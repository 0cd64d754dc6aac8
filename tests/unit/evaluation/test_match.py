import numpy as np
import pytest

from common.env.rally_env import RallyEnv
from common.evaluation.breakdown import survival
from common.evaluation.config import MatchConfig
from common.evaluation.match import FixedRallies, evaluation_rallies, match_task, play_match
from common.evaluation.unplayed_flight import unplayed_flight
from common.physics.flight_model import Flight
from common.policy.config import NetworkConfig
from common.policy.contract import contract_of
from common.policy.folder import Policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.launch import Purpose, draw_rallies
from common.task.observation import critic_layout, size
from common.task.randomization import PROFILES, RALLY_PARAMETERS, draw_parameters
from common.task.states import Outcome, State

NETWORK = NetworkConfig(units=(16, 8))
OBSERVATION = TaskConfig().observation


def make_policy():
    contract = contract_of(
        TaskConfig(), ExperienceConfig(), NETWORK, run="r", generation=1, version=1, stage=3, frames=1
    )
    return Policy(
        new_network(NETWORK, OBSERVATION), Moments.initial(size(critic_layout(OBSERVATION))), contract
    )


def test_each_rally_is_given_once_in_order_and_then_filler_that_is_not_counted():
    rallies = draw_rallies(5, seed=1, purpose=Purpose.EVALUATION)
    filler = draw_rallies(2, seed=1, purpose=Purpose.FALLBACK)
    source = FixedRallies(rallies, filler)

    dealt = [source.take(np.arange(count)) for count in (2, 2, 4, 1)]

    seeds = np.concatenate([d.seeds for d in dealt])
    np.testing.assert_array_equal(seeds[:5], rallies.seeds)
    np.testing.assert_array_equal(seeds[5:], filler.seeds[[0, 1, 0, 1]])
    assert np.concatenate([d.validated for d in dealt]).tolist() == [True] * 5 + [False] * 4


def test_a_match_rates_every_rally_of_the_set_exactly_once():
    policy, rallies = make_policy(), evaluation_rallies(50, TaskConfig(), 4)

    played = play_match(policy, rallies, TaskConfig(), envs=12)

    assert sorted(played.seeds.tolist()) == sorted(rallies.seeds.tolist())


def test_the_same_seed_plays_the_same_match_with_any_number_of_environments():
    policy, rallies = make_policy(), evaluation_rallies(30, TaskConfig(randomization="off"), 4)
    # robots that start at home: the pose after the last stroke depends on the environment
    config = TaskConfig(randomization="off", carry_over=0.0)

    def result(envs):
        played = play_match(policy, rallies, config, envs=envs)
        order = np.argsort(played.seeds)
        return played.outcomes[order], played.returns[order]

    one, again, wider = result(8), result(8), result(30)

    for other in (again, wider):
        np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], again[1])


def test_no_rally_of_an_evaluation_is_a_rally_of_training():
    fixed = evaluation_rallies(500, TaskConfig(), 0)
    trained = [
        draw_rallies(500, seed=0, shard=shard, block=block) for shard in range(2) for block in range(2)
    ]

    np.testing.assert_array_equal(fixed.seeds, evaluation_rallies(500, TaskConfig(), 0).seeds)
    assert not set(fixed.seeds.tolist()) & {seed for block in trained for seed in block.seeds.tolist()}
    assert not np.array_equal(fixed.seeds, evaluation_rallies(500, TaskConfig(), 1).seeds)


def test_a_match_can_be_stopped_between_two_steps():
    def on_tick():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        play_match(
            make_policy(),
            evaluation_rallies(5, TaskConfig(randomization="off"), 4),
            TaskConfig(),
            on_tick=on_tick,
        )


@pytest.mark.timeout(60)
def test_a_failure_of_the_simulation_loses_one_rally_and_the_match_still_ends(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log file of its warnings
    policy, rallies = make_policy(), evaluation_rallies(6, TaskConfig(), 0)
    broken = []
    start = RallyEnv.reset

    def reset_and_break(env):
        obs = start(env)
        env.robot.joint_vel[1] = np.nan
        broken.append(env)
        return obs

    monkeypatch.setattr(RallyEnv, "reset", reset_and_break)
    played = play_match(policy, rallies, TaskConfig(), envs=3)

    assert len(broken) == 1
    assert len(played.seeds) == 5
    assert set(played.seeds) < set(rallies.seeds)


def test_launches_targets_and_flights_are_those_of_the_rallies_beside_them():
    rallies = evaluation_rallies(30, TaskConfig(), 4)
    played = play_match(make_policy(), rallies, TaskConfig(), envs=7)

    assert not np.array_equal(played.seeds, rallies.seeds)  # they end in another order than they begin
    for k, seed in enumerate(played.seeds):
        row = int(np.flatnonzero(rallies.seeds == seed)[0])
        parameters = np.empty(RALLY_PARAMETERS)
        drag, lift, kind = rallies.launches[row, 9:]
        draw_parameters(seed, drag, lift, kind, PROFILES["standard"], parameters)
        bounce, arrival = unplayed_flight(rallies.launches[row : row + 1], parameters[None], Flight.FULL)
        np.testing.assert_array_equal(played.launches[k], rallies.launches[row])
        np.testing.assert_array_equal(played.targets[k], parameters[8:10])
        np.testing.assert_array_equal(played.bounces[k], bounce[0, :2])
        np.testing.assert_array_equal(played.arrivals[k], arrival[0])


def is_returned(seeds):
    """Return which rallies the scripted robot returns: two of three."""
    return np.asarray(seeds) % np.uint64(3) > 0


@pytest.fixture
def scripted_returns(monkeypatch):
    """Let balls of ``is_returned`` land on the opponent's court in their first step, as after a hit."""
    envs = []
    step = RallyEnv.step

    def step_with_returns(env, actions):
        envs.append(env)
        balls = env.rallies
        chosen = np.flatnonzero((balls.state == State.TAU_0) & is_returned(balls.seed))
        balls.ball[chosen] = [0.7, 0.1, 0.1, 0, 0, 0, 0, 0, 0]
        balls.state[chosen] = State.TAU_23
        balls.caught[chosen] = True
        return step(env, actions)

    monkeypatch.setattr(RallyEnv, "step", step_with_returns)
    return envs


@pytest.mark.parametrize("rounds", [1, 3])
@pytest.mark.parametrize("envs", [1, 4])
def test_a_rallys_round_counts_the_returns_before_it_in_its_episode(scripted_returns, rounds, envs):
    rallies = evaluation_rallies(48, TaskConfig(), 4)
    played = play_match(make_policy(), rallies, TaskConfig(rounds=rounds), envs=envs)

    assert scripted_returns[-1].count == envs
    order = np.argsort(played.seeds)
    np.testing.assert_array_equal(
        (played.outcomes == Outcome.RETURNED)[order], is_returned(played.seeds)[order]
    )
    assert sorted(played.seeds.tolist()) == sorted(rallies.seeds.tolist())
    if envs > 1:
        assert set(played.rounds.tolist()) == set(range(1, rounds + 1))
        return
    expected, number = [], 1
    for returned in is_returned(rallies.seeds):  # one environment plays them in order
        expected.append(number)
        number = number + 1 if returned and number < rounds else 1
    np.testing.assert_array_equal(played.rounds, expected)
    np.testing.assert_array_equal(played.seeds, rallies.seeds)


def test_survival_of_a_match_is_that_of_its_episodes_followed_one_by_one(scripted_returns):
    rallies = evaluation_rallies(60, TaskConfig(), 5)
    played = play_match(make_policy(), rallies, TaskConfig(rounds=3), envs=1)

    reached, won, number = [0, 0, 0], [0, 0, 0], 0
    for returned in is_returned(rallies.seeds):
        reached[number] += 1
        won[number] += int(returned)
        number = number + 1 if returned and number < 2 else 0
    length = sum(np.prod([won[j] / reached[j] for j in range(k + 1)]) for k in range(3))
    assert [entry["rallies"] for entry in survival(played)["by_round"]] == reached
    assert survival(played)["rally_length_mean"] == pytest.approx(length, abs=5e-5)


def test_with_several_rounds_the_environments_are_few_enough_for_whole_episodes(scripted_returns):
    rallies = evaluation_rallies(60, TaskConfig(), 4)
    played = play_match(make_policy(), rallies, TaskConfig(rounds=3), envs=60)

    assert scripted_returns[-1].count == 5
    # 2/3 of the balls are returned: of three rounds the first gets 9 of 19
    assert (played.rounds == 1).mean() < 0.7
    assert (played.rounds == 3).sum() > 5


def test_a_match_plays_every_rally_to_its_end(scripted_returns):
    play_match(make_policy(), evaluation_rallies(3, TaskConfig(), 4), TaskConfig(), envs=3)

    experience = scripted_returns[-1].experience
    assert (experience.end_at_hit_share, experience.continue_share) == (0.0, 0.0)
    assert not experience.leads_home


def test_a_match_is_the_contracts_task_under_the_matchs_conditions():
    contract = make_policy().contract
    config = MatchConfig(
        launch="strong", randomization="hard", rounds=5, perception="full", expected_spin="learnt"
    )

    task = match_task(contract, config, config.expected_spin)

    assert (task.launch, task.randomization, task.rounds, task.perception) == ("strong", "hard", 5, "full")
    assert task.observation == OBSERVATION.model_copy(update={"expected_spin": "learnt"})
    assert (task.robot, task.control_rate_hz, task.flight) == ("rails", 50, "full")
