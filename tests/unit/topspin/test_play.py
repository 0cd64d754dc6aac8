import json
from pathlib import Path
from threading import Event

import pytest

from common.errors import ConfigError, StoppedError
from common.policy.folder import save_policy
from common.service.config import load
from tests.unit.evaluation.test_match import make_policy
from topspin import evaluate, pictures, play, progress
from topspin.pictures import PicturesConfig
from topspin.play import PlayConfig
from topspin.policy import load_policy
from topspin.render import film as film_module
from topspin.render.gl import RenderError
from topspin.render.scene import Painter


@pytest.fixture
def folder(tmp_path):
    policy = make_policy()
    save_policy(tmp_path / "policy", policy.network, policy.moments, policy.contract)
    return tmp_path / "policy"


def test_play_prints_the_measures_as_its_last_line(folder, capsys):
    arguments = ["--policy", str(folder), "--rallies", "5", "--film-rallies", "0", "--json"]

    assert play.main(arguments, Event()) == 0

    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (found["rallies"], found["seed"], found["launch"], found["randomization"]) == (
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


def test_the_numbers_come_before_the_film(folder, tmp_path, capsys, monkeypatch):
    printed = []
    monkeypatch.setattr(film_module, "check_tools", lambda path: None)
    monkeypatch.setattr(
        film_module, "film", lambda *given: printed.extend((capsys.readouterr().out, given[-1]))
    )

    play.main(["--policy", str(folder), "--rallies", "6", "--film-rallies", "1"], Event())

    numbers, card = printed
    assert "returned  " in numbers
    assert card.title == "policy: 6 paper balls"
    assert sum(count for _, count, _ in card.bars) == 6
    assert "film of 1 rallies" in capsys.readouterr().out


def test_a_film_that_can_not_be_written_is_refused_before_the_rallies(folder, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    video = tmp_path / "file" / "play.mp4"

    with pytest.raises(RenderError, match=r"can't write .*play\.mp4: (Not a directory|File exists)"):
        play.main(["--policy", str(folder), "--rallies", "4", "--json", "--video", str(video)], Event())

    assert capsys.readouterr().out == ""


def test_the_measures_are_printed_where_the_film_fails(folder, capsys, monkeypatch):
    def film(*_):
        raise RenderError("no space left")

    monkeypatch.setattr(film_module, "check_tools", lambda path: None)
    monkeypatch.setattr(film_module, "film", film)

    with pytest.raises(RenderError):
        play.main(["--policy", str(folder), "--rallies", "4", "--film-rallies", "1", "--json"], Event())

    found = json.loads(capsys.readouterr().out)
    assert found["rallies"] == 4
    assert "video" not in found


def test_play_stops_on_request(folder):
    stop = Event()
    stop.set()

    with pytest.raises(StoppedError, match="stopped before it was done"):
        play.main(["--policy", str(folder), "--film-rallies", "0"], stop)


def test_pictures_stop_on_request(folder, tmp_path):
    stop = Event()
    stop.set()

    with pytest.raises(StoppedError, match="stopped before it was done"):
        pictures.main(["--policy", str(folder), "--out", str(tmp_path), "--rallies", "2"], stop)


@pytest.mark.parametrize("flags", [["--rounds", "5"], ["--envs", "5"]])
def test_pictures_refuse_what_has_no_effect_on_them(flags):
    with pytest.raises(ConfigError):
        load(PicturesConfig, flags, prog="topspin pictures", section="pictures")


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--video", "play.avi"], r"play.video = 'play.avi' \(--video\); allowed: text, matching"),
        (["--expected-spin", "wild"], r"play.expected_spin = 'wild' \(--expected-spin\); allowed: [^()]*$"),
        (["--slow", "0"], r"play.slow = '0' \(--slow\); allowed: a number, from 0.05 to 1"),
        (["--camera", "top"], "allowed: side, behind, target, follow"),
        (["--film-ralies", "3"], "unknown flag --film-ralies; did you mean '--film-rallies'"),
    ],
)
def test_a_bad_setting_is_one_line_that_says_what_is_allowed(flags, line):
    with pytest.raises(ConfigError, match=line):
        load(PlayConfig, flags, prog="p", section="play", environ={})


def test_pictures_are_written_where_the_readme_links_them():
    assert load(PicturesConfig, [], prog="p", section="pictures", environ={}).out == "docs/pictures"


def test_evaluate_measures_under_the_conditions_that_are_given(folder, capsys):
    flags = "--rallies 4 --launch strong --randomization off --rounds 2 --expected-spin learnt --json"

    assert evaluate.main(["--policy", str(folder), *flags.split()], Event()) == 0

    found = json.loads(capsys.readouterr().out)
    assert (found["rallies"], found["launch"], found["randomization"]) == (4, "strong", "off")
    assert (found["rounds"], found["expected_spin"], found["policy"]) == (2, "learnt", str(folder))


def test_evaluate_prints_a_table(folder, capsys):
    evaluate.main(["--policy", str(folder), "--rallies", "4"], Event())

    lines = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines()[:8])
    assert lines["policy"].strip().startswith(f"{folder}, ")
    assert lines["balls"].strip().startswith("4 paper, randomization standard, air full")
    assert " %  (" in lines["returned"]


def test_a_match_says_how_far_it_is_where_there_is_no_terminal(monkeypatch, caplog):
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)

    with caplog.at_level("INFO"), progress.rallies_left(2000) as on_left:
        on_left(1500)
        on_left(0)

    assert [record.getMessage() for record in caplog.records] == [
        "played rallies=500 of=2000",
        "played rallies=2000 of=2000",
    ]


def test_a_path_is_a_folder_even_if_the_box_has_its_name(folder, tmp_path, monkeypatch):
    folder.rename(tmp_path / "default")
    monkeypatch.chdir(tmp_path)

    assert load_policy(Path("default")).contract.frames == load_policy("./default").contract.frames == 1
    assert load_policy("default").contract.frames > 1_000_000
