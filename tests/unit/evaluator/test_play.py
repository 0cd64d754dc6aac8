import json
import sys
from threading import Event

import pytest

from common.config import ConfigError, HelpRequest, load
from common.env.rally_env import EnvConfig
from common.policy.weights import save_policy
from common.render.gl import RenderError
from common.render.scene import Painter
from services.evaluator import play
from services.evaluator.__main__ import SUBCOMMANDS, main
from services.evaluator.once import StoppedError, task_of
from services.evaluator.pictures import PicturesConfig
from services.evaluator.play import PlayConfig, policy_folder
from tests.unit.evaluator.test_match import make_policy


@pytest.fixture
def folder(tmp_path):
    policy = make_policy()
    save_policy(tmp_path / "policy", policy.network, policy.moments, policy.contract)
    return tmp_path / "policy"


def test_play_prints_the_measures_as_its_last_line(folder, capsys):
    arguments = ["--policy", str(folder), "--rallies", "5", "--film-rallies", "0", "--json"]

    assert play.main(arguments, Event()) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["rallies"], found["seed"], found["launch"], found["noise"]) == (
        5,
        20260,
        "paper",
        "standard",
    )
    assert "video" not in found


def test_play_films_the_first_rallies(folder, tmp_path, capsys):
    try:
        Painter(64, 64).close()
    except RenderError as error:
        pytest.skip(f"no OpenGL here: {error}")
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is missing: pip install -e '.[report]'")
    video = tmp_path / "play.mp4"
    arguments = (
        f"--policy {folder} --rallies 3 --film-rallies 1 --video {video} --width 320 --height 180 "
        "--rate-hz 10 --json"
    )

    play.main(arguments.split(), Event())

    assert json.loads(capsys.readouterr().out)["video"] == str(video)
    assert video.stat().st_size > 10_000


def test_play_stops_when_it_is_asked_to(folder):
    stop = Event()
    stop.set()

    with pytest.raises(StoppedError, match="stopped before it was done"):
        play.main(["--policy", str(folder), "--film-rallies", "0"], stop)


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_a_command_has_its_own_help(name, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["evaluator", name, "--help"])

    with pytest.raises(HelpRequest, match=rf"usage: python -m services.evaluator {name}"):
        main(Event())


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--video", "play.avi"], r"play.video = 'play.avi' \(--video\); allowed: text, matching"),
        (["--slow", "0"], r"play.slow = '0' \(--slow\); allowed: a number, from 0.05 to 1"),
        (["--camera", "top"], "allowed: side, behind, target, follow"),
        (["--film-ralies", "3"], "unknown flag --film-ralies; did you mean '--film-rallies'"),
    ],
)
def test_a_bad_setting_is_one_line_that_says_what_is_allowed(flags, line):
    with pytest.raises(ConfigError, match=line):
        load(PlayConfig, flags, prog="p", section="play", environ={})


def test_pictures_go_where_the_readme_looks():
    assert load(PicturesConfig, [], prog="p", section="pictures", environ={}).out == "docs/pictures"


def test_the_shipped_policy_comes_before_the_latest_runs_best(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(policy_folder("")) == "runs/latest/policy/best"

    (tmp_path / "assets/policies/default").mkdir(parents=True)

    assert str(policy_folder("")) == "assets/policies/default"
    assert str(policy_folder("mine")) == "mine"


def test_a_task_takes_robot_and_rate_from_the_policys_contract():
    contract = make_policy().contract.model_copy(update={"robot": "usst", "control_rate_hz": 100})

    task = task_of(contract, EnvConfig(flight="full"), "hard", 3)

    assert (task.robot, task.control_rate_hz, task.noise, task.rounds, task.flight) == (
        "usst",
        100,
        "hard",
        3,
        "full",
    )
