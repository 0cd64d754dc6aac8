"""Rallies by opponent: the order, and what the flight filter remembers."""

import numpy as np

from common.env.rally_env import RallyEnv
from common.evaluation.opponents import EQUAL_BATCH, OpponentRallies, in_equal_batches
from common.perception.flight_track import MILD_PROBABILITY, PRIOR_MILD
from common.task.config import TaskConfig
from common.task.experience import MATCH
from common.task.launch import Purpose, draw_rallies
from tests.unit.evaluation.test_match import make_policy

RALLIES = draw_rallies(6, TaskConfig(launch="strong"), seed=1)
FILLER = draw_rallies(2, seed=1, purpose=Purpose.FALLBACK)


def test_an_environment_gets_all_balls_of_an_opponent_in_order_and_then_filler():
    source = OpponentRallies(RALLIES, np.array([7, 3, 7, 3, 7, 5]), FILLER)

    first, second = source.take(np.array([0, 1])), source.take(np.array([1, 0]))
    rest = [source.take(np.array([0])) for _ in range(3)]

    np.testing.assert_array_equal(first.seeds, RALLIES.seeds[[0, 1]])
    np.testing.assert_array_equal(second.seeds, RALLIES.seeds[[3, 2]])
    np.testing.assert_array_equal([one.seeds[0] for one in rest], [*RALLIES.seeds[[4, 5]], FILLER.seeds[0]])
    assert first.strangers.tolist() == [True, True]
    assert second.strangers.tolist() == [False, False]
    assert [bool(one.strangers[0]) for one in rest] == [False, True, True]
    assert [bool(one.validated[0]) for one in rest] == [True, True, False]


def test_a_robot_remembers_a_player_and_forgets_him_at_the_next_one():
    task = TaskConfig.model_validate({"carry_over": 0.0, "observation": {"expected_spin": "learnt"}})
    env = RallyEnv(1, task, OpponentRallies(RALLIES, np.array([0, 0, 0, 0, 1, 1]), FILLER), experience=MATCH)
    env.reset()
    expected = [env.rallies.track[0, MILD_PROBABILITY]]
    while len(expected) < 6:
        if env.step(env.home_action[None]).ended.size:
            expected.append(env.rallies.track[0, MILD_PROBABILITY])
    prior = env.rallies.track[0, PRIOR_MILD]

    assert expected[0] == expected[4] == prior
    assert prior not in expected[1:4]


def test_a_rows_action_is_the_same_in_any_batch():
    policy = make_policy()
    act = in_equal_batches(policy.act)
    width = policy.network.obs_size
    obs = np.random.default_rng(0).standard_normal((3 * EQUAL_BATCH + 5, width)).astype(np.float32)

    together = act(obs)

    for rows in (slice(0, 1), slice(2, 9), slice(60, 190)):
        np.testing.assert_array_equal(act(obs[rows]), together[rows])
