"""The game behind the page, and the command's mistakes."""

import shutil
import socket
import sys
from dataclasses import replace
from threading import Event, Thread

import numpy as np
import pytest

from common.evaluation.match import evaluation_rallies
from common.policy.contract import PolicyError
from common.policy.folder import save_policy
from common.service.config import ConfigError, load
from common.service.run_folder import RunFolder
from common.service.table import Table
from tests.unit.evaluation.test_match import make_policy
from topspin.report.collect import RunError
from topspin.view import command
from topspin.view.command import ViewError, free_port, wait_for_policy
from topspin.view.config import ViewConfig
from topspin.view.curves import read_curves
from topspin.view.game import BLOCK, Game


def write_policy(folder, frames=1):
    policy = make_policy()
    contract = policy.contract.model_copy(update={"frames": frames})
    save_policy(folder, policy.network, policy.moments, contract)


@pytest.fixture
def run(tmp_path):
    folder = RunFolder(tmp_path / "night")
    folder.create()
    write_policy(folder.latest_policy)
    folder.config.write_text("run = 'night'\n")
    return folder


@pytest.fixture
def config(tmp_path):
    write_policy(tmp_path / "policy")
    return ViewConfig(policy=str(tmp_path / "policy"), seed=4)


def test_the_balls_are_those_of_an_evaluation_with_this_seed(config):
    game = Game(config)

    seeds = [game.next_ball().seed for _ in range(3)]

    assert seeds == evaluation_rallies(BLOCK, game.task, 4).seeds[:3].tolist()


def test_another_preset_or_robot_plays_from_its_first_ball(config):
    game = Game(config)
    paper = game.next_ball()

    game.choose(replace(game.choice, launch="elite", robot="pro"))
    elite = game.next_ball()

    assert np.linalg.norm(paper.ball_vel[0]) < 10.0
    assert 15.0 <= np.linalg.norm(elite.ball_vel[0]) <= 20.0
    assert elite.robot == "pro"
    playing = game.playing()
    assert (playing.robot, playing.trained_on, playing.balls) == ("pro", "rails", "elite")


def test_a_policy_that_can_not_be_read_leaves_the_game_as_it_is(config):
    game = Game(config)
    before = game.choice

    with pytest.raises(PolicyError, match="no policy 'nowhere'; allowed"):
        game.choose(replace(before, policy="nowhere"))

    assert game.choice == before
    game.next_ball()


def test_a_runs_newest_policy_plays(config, run):
    game = Game(ViewConfig(run="night"), run)
    assert game.playing().policy == "run night, 0.0 M frames"
    assert not game.follow()

    write_policy(run.latest_policy, frames=3_000_000)

    assert game.follow()
    assert game.playing().policy == "run night, 3.0 M frames"
    assert not game.follow()


def test_another_policy_is_not_replaced_by_the_runs(config, run):
    game = Game(ViewConfig(run="night"), run)
    game.choose(replace(game.choice, policy=config.policy))

    write_policy(run.latest_policy, frames=3_000_000)

    assert not game.follow()


def test_the_curves_are_those_of_the_runs_evaluations(run):
    assert len(read_curves(run).minutes) == 0
    training = Table(run.metrics, ("frames", "seconds", "stage"))
    evaluations = Table(
        run.evaluations, ("frames", "seconds", "target_error_mean", "catch_rate", "over_rate", "return_rate")
    )
    for k in (1, 2):
        training.append({"frames": 1000 * k, "seconds": 60 * k, "stage": k})
        evaluations.append(
            dict(zip(evaluations._columns, (1000 * k, 60 * k, 0.5 / k, 0.4 * k, 0.3, 0.2 * k), strict=True))
        )

    curves = read_curves(run)

    np.testing.assert_allclose(curves.minutes, [1.0, 2.0])
    np.testing.assert_allclose(curves.return_rate, [20.0, 40.0])
    np.testing.assert_allclose(curves.landing_error, [50.0, 25.0])
    assert (curves.frames, curves.stage) == (2000.0, 2)


def test_a_run_without_a_policy_is_waited_for(run, capsys):
    shutil.move(run.latest_policy, run.root / "later")
    found = []
    waiting = Thread(target=lambda: found.append(wait_for_policy(run, Event())))
    waiting.start()
    shutil.move(run.root / "later", run.latest_policy)
    waiting.join(30)

    assert found == [True]


def test_a_stop_ends_the_wait_for_a_policy(run, capsys):
    shutil.rmtree(run.latest_policy)
    stop = Event()
    stop.set()

    assert not wait_for_policy(run, stop)
    assert "run night has no policy yet" in capsys.readouterr().out


def test_a_taken_port_and_a_foreign_address_are_one_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(ViewError, match=rf"--port {port}: Address already in use; allowed: .*--port 0"):
            free_port("127.0.0.1", port)
    with pytest.raises(ViewError, match=r"can't listen at --host 192\.0\.2\.1 .*: Cannot assign"):
        free_port("192.0.2.1", 0)
    assert free_port("127.0.0.1", 0) > 0


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--port", "99999"], r"view.port = '99999' \(--port\); allowed: a whole number, from 0 to 65535"),
        (["--launch", "fast"], "allowed: paper, strong, mixed, match, elite, serve, all"),
        (["--policy", "mild", "--run", "night"], "--policy mild with --run night; allowed: one of them"),
    ],
)
def test_a_bad_setting_is_one_line_that_says_what_is_allowed(flags, line):
    with pytest.raises(ConfigError, match=line):
        load(ViewConfig, flags, prog="p", section="view", environ={})


def test_an_unknown_run_or_policy_is_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    with pytest.raises(RunError, match="no run 'night'"):
        command.main(["--run", "night"], Event())
    pytest.importorskip("viser", reason="viser is missing: pip install -e '.[view]'")
    with pytest.raises(PolicyError, match="no policy 'x'; allowed"):
        command.main(["--policy", "x", "--port", "0"], Event())


def test_a_missing_library_is_one_line_that_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in [name for name in sys.modules if name.startswith("topspin.view.")]:
        monkeypatch.delitem(sys.modules, name)

    with pytest.raises(ViewError, match=r"the page needs viser, .*; pip install -e '\.\[view\]'"):
        command.main(["--port", "0"], Event())
