"""The recipes of `topspin train`: what they set, and their place between file and defaults."""

import tomllib

import pytest

from common.errors import ConfigError
from common.policy.contract import contract_of
from common.service.config import load, save_settings
from common.task.observation import critic_layout, policy_layout, size
from deploy.config import RECIPES, DeployConfig, settings
from deploy.prepare import prepared
from services.actor.config import ActorConfig
from services.learner.config import LearnerConfig


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def read(*argv) -> DeployConfig:
    return settings(argv, "p")


def leaves(name):
    def walk(table, parent=""):
        for key, value in table.items():
            if isinstance(value, dict):
                yield from walk(value, f"{parent}{key}.")
            else:
                yield f"{parent}{key}", value

    return dict(walk(tomllib.loads((RECIPES / f"{name}.toml").read_text())))


def test_the_papers_recipe_observes_37_numbers_and_its_critic_no_more():
    config = read("--recipe", "paper")
    observation = config.task.observation
    contract = contract_of(
        config.task, config.experience, config.network, run="r", generation=1, version=1, stage=3, frames=1
    )

    assert size(policy_layout(observation)) == size(critic_layout(observation)) == 37
    assert contract.is_end_to_end


def test_the_papers_recipe_has_none_of_our_additions():
    config = read("--recipe", "paper")
    ppo, experience = config.learner.ppo, config.experience

    assert (ppo.correction_weight, ppo.refit_frames, ppo.entropy_weight) == (0.0, 0, 0.0)
    assert (experience.leads_home, experience.teacher.policy) == (False, "")
    assert (experience.continue_share, experience.end_at_hit_share) == (0.0, 0.0)
    assert config.learner.divergence.collapse == 0.0
    assert config.learner.evaluated_weights == "newest"
    assert config.learner.curriculum.count_reset == "raw"


def test_everything_that_counts_frames_is_a_sixteenth_of_the_authors():
    config = read("--recipe", "paper")
    dataset = config.actor.horizon * config.actor.envs

    assert 16 * dataset == 376_832
    assert 16 * config.learner.ppo.minibatch == 8_192
    assert abs(config.frames / dataset - 2_542) < 10  # their datasets


@pytest.mark.parametrize("frames", ["60e6", "600_000"])
def test_the_stages_are_shares_of_the_frames_that_are_given(frames):
    config = read("--recipe", "paper", "--frames", frames)

    assert config.frames == int(float(frames.replace("_", "")))
    assert config.learner.curriculum.stage_shares == (0.14, 0.48, 0.38)


def test_the_recipe_at_50_hz_differs_in_rate_discount_and_trace_alone():
    paper, slow = leaves("paper"), leaves("paper-50hz")

    assert {path for path in paper if paper[path] != slow.get(path)} == {
        *("task.control_rate_hz", "learner.ppo.gamma", "learner.ppo.gae_lambda")
    }
    assert paper.keys() == slow.keys()
    assert slow["learner.ppo.gamma"] == pytest.approx(0.99**4, abs=1e-6)
    assert slow["learner.ppo.gae_lambda"] == pytest.approx(0.95**4, abs=1e-6)


def test_flags_beat_the_file_which_beats_the_recipe_which_beats_the_defaults(tmp_path):
    save_settings(
        tmp_path / "mine.toml", {"learner": {"ppo": {"clip": 0.15, "minibatch": 640}}, "frames": 7000}
    )

    config = read("--recipe", "paper", "--config", "mine.toml", "--learner.ppo.clip", "0.1")

    assert config.learner.ppo.clip == 0.1
    assert (config.learner.ppo.minibatch, config.frames) == (640, 7000)
    assert config.learner.ppo.mini_epochs == 8
    assert config.learner.ppo.target_kl == DeployConfig().learner.ppo.target_kl


def test_a_recipe_can_be_a_file_and_can_be_named_in_the_environment_or_a_file(tmp_path, monkeypatch):
    save_settings(tmp_path / "own.toml", {"learner": {"ppo": {"clip": 0.15}}})
    save_settings(tmp_path / "mine.toml", {"local": {"recipe": "own.toml"}})

    assert read("--recipe", "own.toml").learner.ppo.clip == 0.15
    assert read("--config", "mine.toml").learner.ppo.clip == 0.15
    monkeypatch.setenv("TOPSPIN_LOCAL__RECIPE", "paper")
    assert read().learner.ppo.mini_epochs == 8


def test_a_recipe_that_does_not_exist_is_an_error_with_those_that_do():
    with pytest.raises(ConfigError, match=r"^no recipe 'papr'; allowed: paper, paper-50hz, or a TOML file$"):
        read("--recipe", "papr")


def test_an_unknown_key_in_a_recipe_is_an_error_with_its_file(tmp_path):
    (tmp_path / "own.toml").write_text("[learner.ppo]\nclp = 0.1\n")

    with pytest.raises(
        ConfigError, match=r"unknown key learner\.ppo\.'clp' in own\.toml; did you mean 'clip'"
    ):
        read("--recipe", "own.toml")


def test_shares_of_no_frames_are_refused():
    with pytest.raises(ConfigError, match="stage_shares without frames; allowed: frames above 0"):
        read("--recipe", "paper", "--frames", "0")


def test_the_services_of_a_run_get_the_recipes_settings_and_the_run_records_its_name():
    config = read("--run", "r", "--recipe", "paper")

    with prepared(config) as run:
        tables = tomllib.loads(run.folder.config.read_text())
        argv = ("--config", str(run.folder.config))
        learner = load(LearnerConfig, argv, prog="p", section="learner", environ={})
        actor = load(ActorConfig, argv, prog="p", section="actor", environ={})

    assert tables["local"]["recipe"] == "paper"
    assert (learner.ppo, learner.curriculum, learner.frames) == (
        config.learner.ppo,
        config.learner.curriculum,
        60_000_000,
    )
    assert (actor.task, actor.experience, actor.envs) == (config.task, config.experience, 1472)


@pytest.mark.parametrize("name", ["paper", "paper-50hz"])
def test_a_service_that_is_started_by_hand_reads_a_recipe_as_its_file(name):
    learner = load(
        LearnerConfig, ("--config", str(RECIPES / f"{name}.toml")), prog="p", section="learner", environ={}
    )

    assert learner.ppo == read("--recipe", name).learner.ppo


def test_a_resumed_run_keeps_its_recipe_and_refuses_another():
    with prepared(read("--run", "r", "--recipe", "paper", "--learner.ppo.clip", "0.1")):
        pass

    resumed = read("--run", "r", "--resume")

    assert (resumed.recipe, resumed.learner.ppo.clip) == ("paper", 0.1)
    assert read("--run", "r", "--resume", "--recipe", "paper") == resumed
    with pytest.raises(ConfigError, match="run 'r' started with recipe paper; allowed: no --recipe"):
        read("--run", "r", "--resume", "--recipe", "paper-50hz")
