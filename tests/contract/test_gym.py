"""Gymnasium's requirements on an environment, for the single one and the batch."""

import copy
import sys
import warnings
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordVideo, vector

from common.task.config import TaskConfig
from common.task.observation import PAPER_OBSERVATION, ObservationConfig, policy_layout, size
from common.task.states import Outcome
from tests.unit.env.rallies import make_env
from topspin.gym import RallyGymEnv
from topspin.gym_ids import ENV_ID
from topspin.gym_vector import RallyVectorEnv
from topspin.policy import load_policy
from topspin.render.gl import RenderError
from topspin.render.scene import Painter


def make(**settings) -> gymnasium.Env:
    return gymnasium.make(ENV_ID, **settings)


def make_vec(num_envs: int = 8, **settings) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, **settings)


def play(env: gymnasium.Env, steps: int, seed: int = 0) -> list[np.ndarray]:
    """Return the observations of random play, episode after episode."""
    env.action_space.seed(seed)
    obs, _ = env.reset(seed=seed)
    seen = [obs]
    for _ in range(steps):
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        seen.append(obs)
        if terminated or truncated:
            seen.append(env.reset()[0])
    return seen


def test_gymnasiums_checker_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make().unwrapped, skip_render_check=True)  # a window needs a display; pictures: below


def test_random_play_through_all_wrappers_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        play(make(), 100)


@pytest.mark.parametrize("randomization", ["off", "standard", "hard"])
def test_every_observation_lies_in_the_space(randomization):
    env = make(randomization=randomization)

    assert all(env.observation_space.contains(obs) for obs in play(env, 200))


def test_with_camera_and_filter_every_observation_lies_in_the_space_too():
    env = make(perception="full")

    assert all(env.observation_space.contains(obs) for obs in play(env, 200))


def test_the_spaces_are_the_layouts():
    env = make()

    assert env.observation_space.shape == (37,)
    assert env.observation_space.dtype == np.float32
    np.testing.assert_array_equal(env.action_space.low, [-1] * 7)
    np.testing.assert_array_equal(env.action_space.high, [1] * 7)


def test_a_seed_decides_all_later_rallies():
    one, two, other = play(make(), 150, seed=5), play(make(), 150, seed=5), play(make(), 150, seed=6)

    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one[0], other[0])


def test_resets_without_a_seed_give_new_rallies():
    env = make()
    first, _ = env.reset(seed=1)
    second, _ = env.reset()

    assert not np.array_equal(first, second)


def test_an_episodes_last_observation_is_its_own_and_the_reset_gives_the_next():
    env = make(randomization="off")
    env.reset(seed=1)
    terminated = truncated = False
    while not (terminated or truncated):
        obs, _, terminated, truncated, info = env.step(env.unwrapped._batch.env.home_action)
    ball = env.unwrapped._next_obs[0, 24:27]

    assert not np.allclose(obs[24:27], ball)
    assert Outcome(info["outcome"]) not in (Outcome.NONE, Outcome.TIME_OUT)
    np.testing.assert_array_equal(env.reset()[0][24:27], ball)


def test_a_step_after_an_episodes_end_is_refused():
    env = make(time_limit_s=0.2).unwrapped
    env.reset(seed=1)
    for _ in range(10):
        env.step(np.zeros(7, np.float32))

    with pytest.raises(gymnasium.error.ResetNeeded, match=r"step\(\) after the episode's end"):
        env.step(np.zeros(7, np.float32))


@pytest.mark.parametrize("made", [lambda: make().unwrapped, make_vec], ids=["single", "batch"])
def test_a_step_before_reset_is_refused(made):
    env = made()

    with pytest.raises(gymnasium.error.ResetNeeded, match=r"step\(\) before reset\(\)"):
        env.step(np.zeros(env.action_space.shape, np.float32))


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


def test_an_action_of_another_shape_is_refused_in_the_users_own_shapes():
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of shape \(6,\); allowed: \(7,\)"):
        env.unwrapped.step(np.zeros(6, np.float32))


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


def test_the_single_environment_plays_as_a_batch_of_one():
    single, batch = make(), make_vec(1)
    a, _ = single.reset(seed=3)
    b, _ = batch.reset(seed=3)
    np.testing.assert_array_equal(a, b[0])
    for _ in range(80):
        action = np.zeros(7, np.float32)
        a, reward, terminated, truncated, _ = single.step(action)
        b, rewards, terminations, truncations, infos = batch.step(action[None])

        assert (reward, terminated, truncated) == (rewards[0], terminations[0], truncations[0])
        np.testing.assert_array_equal(a, infos["final_obs"][0] if "final_obs" in infos else b[0])
        if terminated or truncated:
            a, _ = single.reset()
            np.testing.assert_array_equal(a, b[0])


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


def test_settings_reach_the_environment():
    env = make(stage=1, randomization="off", control_rate_hz=200).unwrapped
    env.reset(seed=1)

    played = TaskConfig(
        randomization="off",
        control_rate_hz=200,
        observation=PAPER_OBSERVATION,
    )
    assert env._batch.env.task == played
    assert env._batch.env.stage == 1


@pytest.mark.parametrize(("settings", "shares"), [({}, (0.0, 0.0)), ({"end_at_hit_share": 0.8}, (0.8, 0.0))])
def test_every_rally_is_played_to_its_end_by_default(settings, shares):
    env = make(**settings).unwrapped
    env.reset(seed=1)

    experience = env._batch.env.experience
    assert (experience.end_at_hit_share, experience.continue_share) == shares
    assert not experience.leads_home


def test_an_episode_of_two_rallies_tells_the_facts_of_its_last_one():
    policy = load_policy("default")
    env = make(observation=policy.contract.task.observation, continue_share=1.0)
    second, told = 0, 0
    obs, _ = env.reset(seed=3)
    for _ in range(400):
        obs, _, terminated, truncated, info = env.step(policy.act(obs[None])[0])
        second += env.unwrapped._batch.started._rounds[0] == 2
        assert bool(info) == (terminated or truncated)
        if info:
            told += 1
            obs, _ = env.reset()

    assert second > 20
    assert told > 1


@pytest.mark.parametrize("observation", [ObservationConfig(), {"history": 4}, PAPER_OBSERVATION])
def test_the_simulators_truth_is_in_no_observation(observation):
    """The options of a policy in the box say what its critic observed in training."""
    seen = size(policy_layout(ObservationConfig.model_validate(observation)))
    env, envs = make(observation=observation), make_vec(4, observation=observation)

    assert env.observation_space.shape == env.reset(seed=1)[0].shape == (seen,)
    assert envs.observation_space.shape == envs.reset(seed=1)[0].shape == (4, seen)


def test_an_unknown_setting_is_refused():
    with pytest.raises(ValueError, match="noize"):
        make(noize="off")


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


@pytest.mark.parametrize("made", [make, make_vec], ids=["single", "batch"])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"launch": "wild"}, "launch = 'wild'; Input should be 'paper', 'strong'"),
        ({"launsh": "paper"}, "unknown setting 'launsh'; did you mean 'launch'"),
        ({"stage": 4}, "stage 4; allowed: 1, 2, 3"),
        ({"stage": 3.0}, "stage 3.0; allowed: 1, 2, 3"),
        ({"observation": {"hist": 3}}, "unknown setting 'observation.hist'; did you mean 'history'"),
        ({"reward": {"torqe": 1}}, "unknown setting 'reward.torqe'; did you mean 'torque'"),
        ({"control_rate_hz": 60}, "control_rate_hz = 60; Input should be 25, 50, 100 or 200"),
        ({"continue_share": 2.0}, "continue_share = 2.0; Input should be less than or equal to 1"),
    ],
)
def test_a_bad_setting_is_one_line_with_what_is_allowed(made, settings, message):
    with pytest.raises(ValueError, match=message) as caught:
        made(**settings)

    assert "\n" not in str(caught.value)


def test_an_unknown_mode_is_refused_and_rendering_without_one_returns_none():
    with pytest.raises(ValueError, match=r"render_mode 'ansi'; allowed: None, 'human', 'rgb_array'"):
        RallyGymEnv(render_mode="ansi")
    with pytest.raises(ValueError, match=r"render_mode 'rgb_array'; allowed: None \(films"):
        RallyVectorEnv(2, render_mode="rgb_array")
    with pytest.raises(
        ValueError, match=r"autoreset_mode .*DISABLED; allowed: .*SAME_STEP, AutoresetMode.NEXT_STEP"
    ):
        RallyVectorEnv(2, autoreset_mode=AutoresetMode.DISABLED)
    for env in (RallyGymEnv(), RallyVectorEnv(2)):
        with pytest.warns(UserWarning, match="without a render_mode returns None"):
            assert env.render() is None


@pytest.fixture
def graphics():
    try:
        Painter(64, 64).close()
    except RenderError as error:
        pytest.skip(f"no OpenGL here: {error}")


@pytest.mark.usefixtures("graphics")
def test_pictures_show_the_robot_and_the_ball_at_play():
    with closing(make(render_mode="rgb_array")) as env:
        assert env.render_mode == "rgb_array"
        env.reset(seed=1)
        pictures = [env.render()]
        for _ in range(12):
            env.step(env.action_space.sample())
        pictures.append(env.render())

    for picture in pictures:
        assert (picture.shape, picture.dtype) == ((540, 960, 3), np.uint8)
        assert picture.std() > 20  # not one colour
    # the trail of a ball that is coming is the only thing of this blue
    trails = [np.abs(picture - np.array([80, 180, 240])).max(axis=-1) < 45 for picture in pictures]
    assert trails[1].sum() > trails[0].sum() + 100


@pytest.mark.usefixtures("graphics")
def test_record_video_writes_a_film(tmp_path):
    pytest.importorskip("moviepy", reason="moviepy is missing: pip install moviepy")
    folder = tmp_path / "films"
    env = RecordVideo(make(render_mode="rgb_array"), str(folder), video_length=10, name_prefix="rally")
    with closing(env):
        env.reset(seed=1)
        for _ in range(10):
            env.step(env.action_space.sample())

    assert (folder / "rally-episode-0.mp4").stat().st_size > 10_000


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a display")
def test_a_window_without_a_display_is_one_line(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    with pytest.raises(RenderError, match=r"'human' needs a display, .*; allowed here: 'rgb_array'"):
        RallyGymEnv(render_mode="human")


def test_a_copy_is_refused_with_what_to_do():
    for env in (make(), make_vec(2)):
        env.reset(seed=1)
        with pytest.raises(TypeError, match="can't be copied; make another with the same settings"):
            copy.deepcopy(env)
