"""Gymnasium's requirements on an environment, for the single one, and what it shares with the batch."""

import copy
import sys
import warnings
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import RecordVideo

from common.perception.flight_track import POSTERIOR_MILD
from common.task.config import TaskConfig
from common.task.observation import PAPER_OBSERVATION, ObservationConfig, policy_layout, size
from common.task.states import Outcome
from tests.contract.gyms import make, make_vec, play
from topspin.gym import RallyGymEnv
from topspin.gym_vector import RallyVectorEnv
from topspin.policy import load_policy
from topspin.render.gl import RenderError
from topspin.render.scene import Painter


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


def test_an_action_of_another_shape_is_refused_in_the_users_own_shapes():
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of shape \(6,\); allowed: \(7,\)"):
        env.unwrapped.step(np.zeros(6, np.float32))


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


def test_an_argument_of_the_batch_alone_is_refused_by_name():
    with pytest.raises(ValueError, match=r"^'threads' is an argument of make_vec alone$"):
        RallyGymEnv(threads=2)


def test_a_reset_in_the_middle_of_an_episode_keeps_what_is_known_of_the_opponent():
    """Strong balls show a strong opponent, whom a reset without a seed does not change."""
    observation = ObservationConfig(expected_spin="learnt")
    env = RallyGymEnv(launch="strong", observation=observation, carry_over=0.0)
    env.reset(seed=0)
    ends = 0
    while ends < 6:
        *_, terminated, truncated, _ = env.step(np.zeros(7, np.float32))
        if terminated or truncated:
            env.reset()
            ends += 1

    def is_mild():
        return env._batch.started.rallies.track[0, POSTERIOR_MILD]

    learnt = is_mild()
    env.step(np.zeros(7, np.float32))
    env.reset()

    assert learnt < 0.01
    assert is_mild() == learnt
    env.reset(seed=0)
    assert is_mild() > 0.5


def test_an_unknown_setting_is_refused():
    with pytest.raises(ValueError, match="noize"):
        make(noize="off")


@pytest.mark.parametrize("made", [make, make_vec], ids=["single", "batch"])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"launch": "wild"}, "launch = 'wild'; Input should be 'paper', 'strong'"),
        ({"launsh": "paper"}, "unknown setting 'launsh'; did you mean 'launch'"),
        ({"collision": "original", "rubber": "anti_spin"}, "^rubber anti_spin with"),
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
