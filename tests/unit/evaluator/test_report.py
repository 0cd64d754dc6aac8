"""The report: what runs are one experiment, what made them, the tables, and a whole page from two tiny runs."""

import json
import re
import sys
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import tomli_w

from common.config import ConfigError, HelpRequest
from common.env.rally_env import EnvConfig
from common.errors import ReportedError
from common.policy.actor_critic import NetworkConfig
from common.policy.normalizer import Moments
from common.policy.weights import (
    ACTION_CONTRACT,
    Contract,
    load_policy,
    mean_policy,
    new_network,
    observation_contract,
    save_policy,
)
from common.rally.observation import critic_layout, size
from services.evaluator import report
from services.evaluator.measures import measures
from services.evaluator.report import command
from services.evaluator.report.collect import Run, RunError, Training, read
from services.evaluator.report.command import settings
from services.evaluator.report.config import ReportConfig
from services.evaluator.report.groups import experiment, group
from services.evaluator.report.origin import command as command_of
from services.evaluator.report.origin import run_defaults
from services.evaluator.report.results import (
    GroupResult,
    Results,
    RunResult,
    evaluation_task,
    inequalities,
    spread,
)
from services.evaluator.report.tables import PAPER, Table, headline, markdown
from tests.unit.evaluator.played import MISSED, OUT, RETURNED, make_played

OBSERVATION = EnvConfig().observation


def make_run(name="r", missing=(), **learner):
    return Run(name, {"learner": {"seed": 0, **learner}}, None, None, None, tuple(missing))


def make_result(run, rows, seed=0):
    played = make_played(rows)
    return RunResult(run, seed, "", None, None, played, None, measures(played))


def write_run(root: Path, name: str, seed: int = 0, **local):
    """Write a run's folder with settings, three epochs, two evaluations and a fresh policy."""
    folder = root / "runs" / name
    network = NetworkConfig(units=(8,))
    contract = Contract(
        observation=observation_contract(OBSERVATION), observation_options=OBSERVATION, action=ACTION_CONTRACT,
        network=network, control_rate_hz=50, robot="rails", launch="paper", noise="standard", run=name,
        generation=1, version=3, stage=2, frames=3000,
    )  # fmt: skip
    moments = Moments.initial(size(critic_layout(OBSERVATION)))
    save_policy(folder / "policy" / "best", new_network(network, OBSERVATION), moments, contract)
    shared = {"seed": seed, "run": name, "endpoint": f"tcp/127.0.0.1:{7000 + seed}"}
    sections = {"local": {"run": name, "seed": seed, **local}, "learner": {**shared, **local}}
    (folder / "config.toml").write_text(tomli_w.dumps(sections))
    (folder / "metrics.csv").write_text(
        "epoch,frames,seconds,stage\n1,1000,10,1\n2,2000,20,1\n3,3000,90,2\n4,40"  # killed within a line
    )
    (folder / "report").mkdir()
    (folder / "report" / "evaluations.csv").write_text(
        "version,frames,stage,seconds,catch_rate,over_rate,return_rate,target_error_mean\n"
        "0,0,1,3,0.1,0.05,0.02,\n1,2500,1,9,0.2,0.1,0.05,0.9\n2,2000,1,5,0.5,0.3,0.2,0.6\n3,3000,2,8,0.6,0.4,0.3,0.5\n"
    )
    return folder


# ---- reading


def test_a_resumed_runs_evaluations_count_once_and_at_the_learners_time(tmp_path):
    curve = read(str(write_run(tmp_path, "a"))).curve

    np.testing.assert_array_equal(curve.frames, [0, 2000, 3000])
    np.testing.assert_allclose(curve.minutes, [0, 20 / 60, 90 / 60])
    np.testing.assert_array_equal(curve.values["target_error_mean"], [np.nan, 0.6, 0.5])


def test_a_stage_begins_with_the_frames_before_its_first_epoch():
    training = Training(np.array([1.0, 2.0, 3.0, 4.0]), np.zeros(4), np.array([1.0, 1.0, 2.0, 3.0]))

    assert training.stage_changes() == [(2, 2.0), (3, 3.0)]


def test_a_run_that_is_not_there_is_named_with_those_that_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "night")

    with pytest.raises(RunError, match=r"no run 'nigth'.*runs there: night$"):
        read("nigth")


def test_a_run_without_evaluations_or_policy_says_so(tmp_path):
    folder = write_run(tmp_path, "a")
    (folder / "report" / "evaluations.csv").unlink()
    (folder / "metrics.csv").unlink()

    run = read(str(folder))
    assert run.curve is None
    assert [what.split(":")[0] for what in run.missing] == [
        "no epochs in metrics.csv",
        "no evaluations in report/evaluations.csv",
    ]
    (folder / "policy" / "best").rename(folder / "policy" / "latest")
    with pytest.raises(
        RunError, match=r"run 'a' has nothing to report: .*policy/best isn't there.*--policy latest"
    ):
        read(str(folder))


# ---- groups


def test_runs_that_differ_only_in_seed_name_and_reach_are_one_experiment():
    runs = [
        make_run("a", ppo={"clip": 0.2}, run="a", endpoint="tcp/1", minutes=1.0),
        make_run("b", ppo={"clip": 0.1}),
        make_run(
            "c",
            ppo={"clip": 0.2},
            run="c",
            endpoint="tcp/2",
            metrics_port=9,
            minutes=2.0,
            frames=7,
            folder="x",
        ),
    ]
    runs[2].settings["learner"]["seed"] = 5

    assert [[run.name for run in one.runs] for one in group(runs)] == [["a", "c"], ["b"]]


def test_how_a_run_is_evaluated_makes_no_experiment():
    assert experiment({"evaluator": {"rallies": 9}, "local": {"evaluator": {"rallies": 9}, "actors": 2}}) == {
        "local.actors": 2
    }


def test_what_was_asked_for_a_service_counts_as_it_came_to_be():
    """0: as many as share out; a file of earlier releases says what that was."""
    asked = {"local": {"actor": {"envs": 0}}, "actor": {"envs": 256}}
    written = {"local": {"actor": {"envs": 256}}, "actor": {"envs": 256}}

    assert experiment(asked) == experiment(written) == {"actor.envs": 256}


def test_groups_are_called_by_what_tells_them_apart():
    privileged = {"observation": {"critic": "privileged"}}
    usual = {"spin": "estimated", "prediction": True, "age": True}
    groups = group(
        [
            make_run("a", env=privileged),
            make_run("b", env=privileged, curriculum={"first_stage": 3}),
            make_run("c", env=privileged | {"collision": "original"}),
            make_run("d", env={"observation": {"critic": "policy", "history": 8, "spin": "true"}}),
            make_run("e", env={"observation": {"critic": "policy", "spin": "estimated", "age": True}}),
            make_run("f", env={"observation": {"critic": "privileged", "prediction": True}}),
            make_run("g", env={"observation": {"critic": "privileged"} | usual}),
            make_run("h", env={"observation": {"critic": "privileged", "ball": "filtered"}}),
            make_run("i", env={"observation": {"critic": "privileged", "ball": "filtered"} | usual}),
            make_run("j", env=privileged | {"teacher": {"policy": "assets/policies/default"}}),
            make_run("k", env=privileged | {"teacher": {"policy": "assets/policies/default", "notes": True}}),
        ]
    )

    assert [one.label for one in groups] == [
        "stages 1+2+3, 37 numbers",
        "stage 3 only, 37 numbers",
        "stages 1+2+3, original collisions, 37 numbers",
        "stages 1+2+3, history 8 + true spin, critic sees no more",
        "stages 1+2+3, estimated spin + sample age, critic sees no more",
        "stages 1+2+3, prediction",
        "stages 1+2+3",
        "stages 1+2+3, 37 numbers, ball filtered",
        "stages 1+2+3, ball filtered",
        "stages 1+2+3, taught by default, 37 numbers",
        "stages 1+2+3, taught by default with notes, 37 numbers",
    ]
    assert groups[0].description == (
        "stages 1+2+3, tailored collisions, sees 37 numbers, critic sees the truth"
    )


def test_experiments_of_one_name_are_told_apart_by_the_settings_that_differ():
    runs = [make_run("a", ppo={"clip": 0.2, "gamma": 0.99}), make_run("b", ppo={"clip": 0.1, "gamma": 0.99})]

    assert [one.label for one in group(runs)] == ["stages 1+2+3, clip 0.2", "stages 1+2+3, clip 0.1"]


# ---- commands


def test_a_command_is_the_settings_that_are_not_the_defaults():
    defaults = {
        "actors": 2,
        "seed": 0,
        "env.noise": "standard",
        "learner.ppo.clip": 0.2,
        "network.units": (8, 4),
    }
    local = {
        "run": "a b",
        "actors": 4,
        "seed": 0,
        "panel": "off",
        "endpoint": "tcp/1",
        "evaluate": False,
        "env": {"noise": "standard"},
        "learner": {"ppo": {"clip": 0.1}},
        "network": {"units": [8, 4]},
    }

    assert command_of("a b", {"local": local}, defaults | {"evaluate": True}) == (
        "python -m deploy.local --run 'a b' --actors 4 --evaluate false --learner.ppo.clip 0.1"
    )


def test_a_command_makes_the_settings_it_was_made_from():
    deploy = pytest.importorskip("deploy.config")
    load = pytest.importorskip("common.config").load
    argv = "--run n --actors 3 --env.observation.history 8 --network.units 64,32 --learner.curriculum.first-stage 3"
    config = load(deploy.DeployConfig, argv.split(), prog="p", section="local", environ={})

    found = command_of("n", {"local": config.model_dump(mode="json", by_alias=True)}, run_defaults())

    again = load(deploy.DeployConfig, found.split()[3:], prog="p", section="local", environ={})
    assert again == config
    assert sorted(found.split()[3:]) == sorted(argv.split())


# ---- tables


def test_a_table_is_markdown():
    table = Table("t", ("bin", "rate"), (("a|b", "1 %"), ("ours", "2 %")), frozenset({1}))

    assert markdown(table) == "| bin | rate |\n|---|---:|\n| a\\|b | 1 % |\n| **ours** | 2 % |\n"


def test_the_headline_has_the_papers_rows_and_ours_with_spread_and_interval():
    run = make_run()
    results = [
        make_result(run, [RETURNED] * 8 + [OUT, MISSED]),
        make_result(run, [RETURNED] * 6 + [OUT] * 4, seed=1),
    ]
    rows = [RETURNED] * 14 + [OUT] * 5 + [MISSED]
    names = ("catch_rate", "return_rate", "return_after_catch", "target_error_mean")
    one = GroupResult(
        "stages 1+2+3", "", tuple(results), make_played(rows), measures(make_played(rows)),
        {name: spread(results, name) for name in names}, {}, {},
    )  # fmt: skip
    table = headline(Results((one,), ReportConfig(), {}, {}, ()))

    assert table.rows[: len(PAPER)] == PAPER
    # returned: .8 and .6, sample deviation .1414; 14 of 20; after catch 8/9 and 6/10; 14 of 19
    assert table.rows[len(PAPER) :] == (
        (
            "Topspin, stages 1+2+3 (2 seeds)",
            "yes",
            "70.0 ± 14.1 % [48.1, 85.5]",
            "74.4 ± 20.4 % [51.2, 88.2]",
            "0.200 ± 0.000 m [0.200, 0.200]",
        ),
    )


def test_works_are_rightly_named_beside_the_papers_rows():
    rows = {row[0]: row[3:] for row in PAPER}

    assert rows["Hu et al. 2025, stages 1+2+3"] == ("90 %", "0.31 m")
    assert rows["Focused player (Koç et al. 2018)"] == ("–", "0.25 m")
    assert rows["8dof + GCBC + SSP (GoalsEye, Ding et al. 2022)"] == ("–", "0.84 m")


# ---- the command line


def test_words_that_are_neither_flags_nor_their_values_are_runs():
    config = settings(["a", "--rallies", "5", "b", "--rounds-too", "c", "--out", "o"])

    assert (config.runs, config.rallies, config.rounds_too, config.out) == (("a", "b", "c"), 5, True, "o")


def test_no_run_and_unknown_flags_are_errors_and_help_is_real():
    with pytest.raises(ConfigError, match="no run to report on"):
        settings([])
    with pytest.raises(ConfigError, match="unknown flag --ralies; did you mean '--rallies'"):
        settings(["a", "--ralies", "5"])
    with pytest.raises(
        HelpRequest, match=r"report RUN\.\.\.(.|\n)*--rallies +rallies that each policy plays"
    ):
        settings(["--help"])


def test_without_its_libraries_a_report_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "services.evaluator.report.figures", None)
    monkeypatch.delattr(report, "figures", raising=False)  # where an earlier test has imported it

    with pytest.raises(ReportedError, match=r"pip install -e '\.\[report\]'"):
        command.main([str(write_run(tmp_path, "a"))], Event())


def test_policies_are_measured_on_our_task_whatever_they_were_trained_on(tmp_path):
    policy = read(str(write_run(tmp_path, "a"))).policy

    task = evaluation_task(policy)
    assert (task.noise, task.collision, task.rounds, task.control_rate_hz) == ("standard", "tailored", 1, 50)
    assert task.observation == policy.contract.observation_options


def test_runs_of_unequal_length_or_of_one_seed_are_said_to_be():
    def of(*frames_and_seeds):
        runs = tuple(
            RunResult(make_run(), seed, "", frames, None, None, None, {}) for frames, seed in frames_and_seeds
        )
        return GroupResult("ours", "", runs, None, {}, {}, {}, {})

    assert not [*inequalities([of((10_000_000, 0), (10_002_432, 1), (None, 2))])]
    assert [*inequalities([of((10_000_000, 0), (60_000_000, 1)), of((5, 3), (5, 3))])] == [
        "ours: its runs are of different length, 10.0 to 60.0 M frames",
        "ours: several runs of seed 3",
    ]


def test_a_mean_of_policies_is_said_to_be_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    best = write_run(tmp_path, "a") / "policy" / "best"
    policy = load_policy(best)
    mean = mean_policy([policy, policy])
    save_policy(best, mean.network, mean.moments, mean.contract)

    command.main(["a", "--rallies", "24", "--envs", "24", "--out", "o"], Event())

    page = (tmp_path / "o" / "report.md").read_text()
    assert "| **Topspin, stages 1+2+3 (1 seed, mean of 2 policies)** |" in page
    assert "mean of 2, to 0.0 M, stage 2" in page
    assert "its policy is the mean of 2\n#     a 3000 frames, launch paper\n#     a 3000 frames" in page
    found = json.loads((tmp_path / "o" / "results.json").read_text())
    assert found["groups"][0]["runs"][0]["policy"]["mean_of"] == ["a 3000 frames, launch paper"] * 2


def test_two_tiny_runs_make_a_whole_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "a", seed=0)
    (write_run(tmp_path, "b", seed=1) / "metrics.csv").unlink()

    (tmp_path / "note.txt").write_text("It plays\nwell | mostly.\n\n\nSecond <thing>.\n")

    words = ["a", "b", "a", "--rallies", "24", "--envs", "24", "--rounds-too", "--out", "o"]
    command.main([*words, "--note", "note.txt"], Event())

    assert capsys.readouterr().out.split() == ["o/report.md", "o/report.html", "o/results.json"]
    found = json.loads((tmp_path / "o" / "results.json").read_text())
    (one,) = found["groups"]
    assert one["seeds"] == [0, 1]
    assert [run["measures"]["rallies"] for run in one["runs"]] == [24, 24]
    assert one["pooled"]["rallies"] == 48
    assert one["over_seeds"]["catch_rate"]["seeds"] == 2
    assert one["runs"][0]["stage_changes"] == [[2, 2000.0]]
    assert found["missing"] == ["b: no epochs in metrics.csv: frames, hours and stages are unknown"]
    page = (tmp_path / "o" / "report.md").read_text()
    assert "| **Topspin, stages 1+2+3 (2 seeds)** | yes |" in page
    assert "- b: no epochs in metrics.csv" in page
    assert "## In words\n\nIt plays well | mostly.\n\nSecond <thing>.\n" in page
    assert "--rounds-too --note note.txt" in page
    assert "python -m deploy.local --run b --seed 1" in page
    drawn = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert {"curves_frames.png", "landings.png", "courts.png", "rates.png", "rounds.png"} <= set(drawn)
    assert all((tmp_path / "o" / name).stat().st_size > 5000 for name in drawn)
    html = (tmp_path / "o" / "report.html").read_text()
    assert html.count("<img ") == len(drawn)
    assert "<p>Second &lt;thing&gt;.</p>" in html
    assert set(re.findall(r'(?:src|href)="(.{22})', html)) == {"data:image/png;base64,"}
    assert str(tmp_path) not in page + html + json.dumps(found)


def test_a_note_that_cant_be_read_is_said_before_anything_is_played(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "a")

    with pytest.raises(ReportedError, match=r"can't read the note no\.txt: No such file"):
        command.main(["a", "--note", "no.txt"], Event())
    assert not (tmp_path / "runs" / "report").exists()
