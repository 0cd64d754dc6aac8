"""Gymnasium's requirements on a vector environment, for the batch."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector

from common.task.observation import ObservationConfig
from common.task.states import Outcome
from tests.contract.gyms import make, make_vec
from tests.unit.env.rallies import make_env
from topspin.gym import RallyGymEnv


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_the_batch_states_when_it_resets(mode):
    assert make_vec(autoreset_mode=mode).metadata["autoreset_mode"] is mode
    assert make_vec(autoreset_mode=mode.value).metadata["autoreset_mode"] is mode
    assert make_vec().metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def sync_vec(mode: AutoresetMode, num_envs: int = 1, **settings) -> gymnasium.vector.SyncVectorEnv:
    """Return Gymnasium's own vector environment over single ones: it defines what a mode means."""
    makers = [lambda: RallyGymEnv(**settings)] * num_envs
    return gymnasium.vector.SyncVectorEnv(makers, autoreset_mode=mode)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_batch_of_one_is_gymnasiums_own_vector_of_one(mode):
    """Step by step, through many ends: observation, reward, flags, and infos with their masks."""
    settings = {"carry_over": 0.0, "observation": ObservationConfig()}
    ours, theirs = make_vec(1, autoreset_mode=mode, **settings), sync_vec(mode, **settings)
    first, _ = ours.reset(seed=4)
    np.testing.assert_array_equal(first, theirs.reset(seed=4)[0])
    random, ends = np.random.default_rng(0), 0
    for _ in range(300):
        action = random.uniform(-1, 1, (1, 7)).astype(np.float32)
        *got, infos = ours.step(action)
        *wanted, wanted_infos = theirs.step(action)

        for ours_is, theirs_is in zip(got, wanted, strict=True):
            np.testing.assert_array_equal(ours_is, theirs_is)
            assert ours_is.dtype == theirs_is.dtype
        assert_same_infos(infos, wanted_infos)
        ends += int(got[2][0] or got[3][0])

    assert ends >= 5


def assert_same_infos(got: dict, wanted: dict) -> None:
    assert got.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, dict):
            assert_same_infos(got[name], value)
        elif value.dtype == object:
            np.testing.assert_array_equal(got[name][0], value[0])
        else:
            np.testing.assert_array_equal(got[name], value)


def test_the_step_after_an_end_ignores_its_action_and_pays_nothing():
    """NEXT_STEP: an environment that ended begins again in the next step, whatever it is told to do there."""
    one, two = (make_vec(8, autoreset_mode=AutoresetMode.NEXT_STEP, time_limit_s=0.5) for _ in range(2))
    for envs in (one, two):
        envs.reset(seed=1)
    random, ended, ends = np.random.default_rng(0), np.zeros(8, np.bool_), 0
    for _ in range(120):
        actions = random.uniform(-1, 1, (8, 7)).astype(np.float32)
        others = np.where(ended[:, None], -actions, actions)
        obs, rewards, terminated, truncated, infos = one.step(actions)
        for got, same in zip((obs, rewards, terminated, truncated), two.step(others), strict=False):
            np.testing.assert_array_equal(got, same)

        assert not rewards[ended].any()
        assert not (terminated | truncated)[ended].any()
        ended = terminated | truncated
        assert not ended.any() or np.array_equal(infos["_outcome"], ended)
        assert "final_obs" not in infos
        ends += ended.sum()

    assert ends >= 16


def test_a_reset_with_a_mask_takes_the_place_of_the_step_that_begins_the_next_episode():
    envs = make_vec(2, autoreset_mode=AutoresetMode.NEXT_STEP, time_limit_s=0.2)
    envs.reset(seed=1)
    ended = np.zeros(2, np.bool_)
    while not ended.all():
        *_, terminated, truncated, _ = envs.step(np.zeros((2, 7), np.float32))
        ended = terminated | truncated
    begun, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    obs, *_ = envs.step(np.zeros((2, 7), np.float32))

    lengths = envs.unwrapped._batch.env._lengths
    np.testing.assert_array_equal(lengths, [1, 0])
    assert not np.array_equal(obs[0], begun[0])


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("collision", ["tailored", "original"])
def test_results_do_not_depend_on_the_number_of_threads(mode, collision):
    played = []
    for threads in (1, 2, 5):
        envs = make_vec(16, threads=threads, autoreset_mode=mode, collision=collision, time_limit_s=0.5)
        obs, _ = envs.reset(seed=3)
        random, trace = np.random.default_rng(0), [obs]
        for _ in range(60):
            obs, rewards, terminated, truncated, _ = envs.step(random.uniform(-1, 1, (16, 7)))
            trace += [obs, rewards, terminated, truncated]
        played.append(trace)
        assert envs.unwrapped._batch.env.robot.batch.nthread == threads

    for other in played[1:]:
        for got, wanted in zip(other, played[0], strict=True):
            np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("settings", [{"threads": 0}, {"num_envs": 0}, {"num_envs": 2.5}, {"num_envs": "8"}])
def test_a_count_below_one_or_no_whole_number_is_refused(settings):
    with pytest.raises(ValueError, match=r"(threads|num_envs) .*; allowed: a whole number from 1"):
        make_vec(**settings)


def test_the_batch_has_the_spaces_of_its_environments():
    envs = make_vec(5)
    obs, info = envs.reset(seed=1)

    assert envs.single_observation_space == make().observation_space
    assert envs.observation_space.contains(obs)
    assert envs.action_space.shape == (5, 7)
    assert info == {}


def test_the_batch_returns_last_observation_and_info_in_gymnasiums_form():
    """As SyncVectorEnv does with SAME_STEP: objects by row, None elsewhere, masks with an underscore."""
    envs = make_vec(8, randomization="off", time_limit_s=0.5)
    envs.reset(seed=1)
    ends = 0
    for _ in range(60):
        obs, rewards, terminated, truncated, infos = envs.step(np.zeros((8, 7), np.float32))
        ended = terminated | truncated
        assert ("final_obs" in infos) == ended.any()
        if not ended.any():
            continue
        ends += ended.sum()
        np.testing.assert_array_equal(infos["_final_obs"], ended)
        np.testing.assert_array_equal(infos["_final_info"], ended)
        for row in range(8):
            final = infos["final_obs"][row]
            assert (final is not None) == ended[row]
            if ended[row]:
                assert envs.single_observation_space.contains(final)
                assert not np.array_equal(final, obs[row])
                assert (infos["final_info"]["outcome"][row] == Outcome.TIME_OUT) == truncated[row]

    assert ends >= 8
    assert rewards.dtype == np.float64


@pytest.mark.parametrize(("mode", "steps"), [("SameStep", [10, 20]), ("NextStep", [10, 21])])
def test_gymnasiums_episode_statistics_work_on_the_batch(mode, steps):
    envs = vector.RecordEpisodeStatistics(make_vec(8, time_limit_s=0.2, autoreset_mode=mode))
    envs.reset(seed=1)
    found = {}
    for step in range(1, 25):
        *_, infos = envs.step(np.zeros((8, 7), np.float32))
        if "episode" in infos:
            found[step] = infos["episode"]["l"]

    assert list(found) == steps
    np.testing.assert_array_equal(list(found.values()), 10)


def test_the_batch_plays_as_its_inner_environment():
    envs = make_vec(4, randomization="off", stage=1)
    envs.reset(seed=1)
    inner = envs.unwrapped._batch.env

    assert inner.count == 4
    assert inner.home_action.shape == make_env(1).home_action.shape


def test_a_reset_mask_begins_those_episodes_and_leaves_the_others():
    envs, untouched = make_vec(4, randomization="off"), make_vec(4, randomization="off")
    for each in (envs, untouched):
        each.reset(seed=1)
        each.step(np.zeros((4, 7), np.float32))
    mask = np.array([False, True, False, True])
    before, *_ = untouched.step(np.zeros((4, 7), np.float32))
    envs.step(np.zeros((4, 7), np.float32))
    obs, info = envs.reset(options={"reset_mask": mask})

    np.testing.assert_array_equal(obs[~mask], before[~mask])
    assert not np.any(np.all(obs[mask] == before[mask], axis=1))
    assert info == {}
    np.testing.assert_array_equal(
        envs.step(np.zeros((4, 7), np.float32))[0][~mask],
        untouched.step(np.zeros((4, 7), np.float32))[0][~mask],
    )


@pytest.mark.parametrize(
    ("options", "seed", "message"),
    [
        (
            {"reset_mask": np.array([True])},
            None,
            r"reset_mask of shape \(1,\) and bool, 1 set; allowed: \(4,\)",
        ),
        ({"reset_mask": np.ones(4)}, None, "and float64, 4 set; allowed"),
        ({"reset_mask": np.zeros(4, np.bool_)}, None, "0 set; allowed"),
        ({"reset_mask": np.array([True, False, False, False])}, 3, "seed with a reset_mask"),
        (None, [1, 2], r"seed \[1, 2\]; allowed: a whole number from 0, or 4 of them"),
        (None, [1, 2, 3, None], "seed .*None.*; allowed"),
    ],
)
def test_a_reset_of_the_batch_that_it_can_not_do_is_refused(options, seed, message):
    envs = make_vec(4)
    envs.reset(seed=1)

    with pytest.raises(ValueError, match=message):
        envs.reset(seed=seed, options=options)


def test_a_seed_for_each_environment_repeats_the_episodes():
    envs = make_vec(3)
    first, _ = envs.reset(seed=[1, 2, 3])
    again, _ = make_vec(3).reset(seed=[1, 2, 3])
    other, _ = envs.reset(seed=[1, 2, 4])

    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
