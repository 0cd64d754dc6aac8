"""Recordings of named players: what is learnt goes from ball to ball of one player, and nothing depends on --envs."""

import json
from threading import Event

import pytest

from common.policy.folder import save_policy
from common.task.config import TaskConfig
from common.task.launch import draw_rallies
from tests.unit.evaluation.test_match import make_policy
from tests.unit.topspin.real2sim.flights import launch_of, seen
from tests.unit.topspin.real2sim.test_command import settings, write_csv, write_states
from topspin.real2sim import command, play
from topspin.real2sim.dataset import read
from topspin.real2sim.formats.recordings import load


@pytest.fixture
def policy(tmp_path):
    made = make_policy()
    save_policy(tmp_path / "policy", made.network, made.moments, made.contract)
    return str(tmp_path / "policy")


def write_players(path, count=24, players=3):
    """Write strong states of several players in turn, in DeepMind's format."""
    block = draw_rallies(count, TaskConfig(launch="strong", randomization="off"), seed=2)
    write_states(path, block.launches)
    entries = json.loads(path.read_text())
    for k, entry in enumerate(entries):
        entry["player"] = f"p{k % players}"
    path.write_text(json.dumps(entries))
    return path


def test_the_number_of_environments_changes_nothing(policy, tmp_path, capsys):
    data = write_players(tmp_path / "s.json")
    found = []
    for envs in (1, 7, 250):
        flags = [
            "--data",
            str(data),
            "--policy",
            policy,
            "--envs",
            str(envs),
            "--expected-spin",
            "learnt",
            "--json",
        ]
        command.main(flags, Event())
        result = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert result.pop("seconds") > 0.0
        found.append(result)

    assert found[0] == found[1] == found[2]
    assert found[0]["rallies"] == 24
    assert found[0]["expected_spin"] == "learnt"


def test_a_player_is_one_opponent_and_an_unknown_one_is_met_once(tmp_path):
    block = draw_rallies(4, TaskConfig(randomization="off"), seed=2)
    data = write_states(tmp_path / "s.json", block.launches)
    entries = json.loads(data.read_text())
    for entry, player in zip(entries, ("a", None, "a", None), strict=True):
        if player:
            entry["player"] = player
    data.write_text(json.dumps(entries))
    found = read(settings(data=str(data)), TaskConfig().flight_model)

    assert found.rallies.players == ("a", "", "a", "")
    assert found.opponents(are_remembered=True).tolist() == [0, 1, 0, 2]
    assert found.opponents(are_remembered=False).tolist() == [0, 1, 2, 3]


def test_a_table_and_a_sidecar_name_players(tmp_path):
    path = write_csv(tmp_path / "t.csv", seen(launch_of()), seen(launch_of()))
    lines = path.read_text().splitlines()
    lines = [f"{line},{'player' if not k else line.split(',')[0].upper()}" for k, line in enumerate(lines)]
    path.write_text("\n".join(lines))

    assert [track.player for track in load(path).tracks] == ["T0", "T1"]

    write_csv(path, seen(launch_of()))
    path.with_suffix(".toml").write_text('player = "Ma"')

    assert [track.player for track in load(path).tracks] == ["Ma"]


def test_the_expected_spin_is_the_commands(tmp_path):
    task = play.task_of(make_policy().contract, settings(expected_spin="strong"))

    assert task.observation.expected_spin == "strong"
    assert task.carry_over == 0.0
    assert play.task_of(make_policy().contract, settings()).observation.expected_spin == "mild"
