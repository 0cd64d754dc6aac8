"""The report: groups of runs, their commands, the tables, and a whole page from two tiny runs."""

import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w

from common.errors import ConfigError, HelpRequest, ReportedError
from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError, contract_of
from common.policy.folder import load_policy, mean_policy, save_policy
from common.policy.normalizer import Moments
from common.policy.weights import new_network
from common.service.config import load, to_tables
from common.task.config import TaskConfig
from common.task.experience import ExperienceConfig
from common.task.observation import PAPER_OBSERVATION, critic_layout, size
from deploy.config import RECIPES, DeployConfig
from tests.unit.topspin.report.runs import make_run
from topspin import report
from topspin.report import command
from topspin.report import results as results_module
from topspin.report.collect import CURVES, Curve, RunError, TrainingCurve, read
from topspin.report.command import make_folder, settings
from topspin.report.config import ReportConfig
from topspin.report.figures import curves
from topspin.report.groups import experiment, group
from topspin.report.provenance import command as command_of
from topspin.report.provenance import own_command
from topspin.report.results import GroupResult, RunResult, evaluation_task, inequalities, spread

OBSERVATION = TaskConfig().observation


def write_run(root: Path, name: str, seed: int = 0, **local):
    """Write a run's folder with settings, three epochs, two evaluations and a fresh policy."""
    folder = root / "runs" / name
    network = NetworkConfig(units=(8,))
    contract = contract_of(
        TaskConfig(), ExperienceConfig(), network, run=name, generation=1, version=3, stage=2, frames=3000
    )
    moments = Moments.initial(size(critic_layout(OBSERVATION)))
    save_policy(folder / "policy" / "best", new_network(network, OBSERVATION), moments, contract)
    shared = {"seed": seed, "run": name, "endpoint": f"tcp/127.0.0.1:{7000 + seed}"}
    sections = {**shared, "local": local}
    (folder / "config.toml").write_text(tomli_w.dumps(sections))
    (folder / "metrics.csv").write_text(
        "epoch,frames,seconds,stage\n1,1000,10,1\n2,2000,20,1\n3,3000,90,2\n4,40"  # its writer was killed
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
    training = TrainingCurve(np.array([1.0, 2.0, 3.0, 4.0]), np.zeros(4), np.array([1.0, 1.0, 2.0, 3.0]))

    assert training.stage_changes() == [(2, 2.0), (3, 3.0)]


def test_an_unknown_run_is_named_with_the_existing_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "night")

    with pytest.raises(RunError, match=r"no run 'nigth'.*runs there: night$"):
        read("nigth")


def test_a_run_without_evaluations_or_policy_is_reported(tmp_path):
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


def test_runs_that_differ_only_in_seed_name_and_connection_are_one_experiment():
    runs = [
        make_run("a", learner={"ppo": {"clip": 0.2}}, run="a", endpoint="tcp/1", minutes=1.0),
        make_run("b", learner={"ppo": {"clip": 0.1}}),
        make_run(
            "c",
            learner={"ppo": {"clip": 0.2}},
            run="c",
            endpoint="tcp/2",
            local={"metrics_port": 9},
            minutes=2.0,
            frames=7,
            seed=5,
        ),
    ]

    assert [[run.name for run in one.runs] for one in group(runs)] == [["a", "c"], ["b"]]


def test_evaluation_settings_make_no_experiment():
    assert experiment({"evaluator": {"rallies": 9}, "task": {"rounds": 2}}) == {"task.rounds": 2}


@pytest.mark.parametrize(
    ("actors", "envs", "environments"), [(1, 0, 256), (2, 0, 256), (2, 128, 256), (64, 0, 1024), (3, 10, 30)]
)
def test_of_actors_the_number_of_all_environments_makes_the_experiment(actors, envs, environments):
    found = experiment({"actors": actors, "actor": {"envs": envs}})

    assert found == {"environments": environments}


def test_where_a_dataset_is_a_number_of_rollouts_actors_and_their_environments_count_each():
    settings = {"actors": 2, "actor": {"envs": 9}, "learner": {"intake": {"dataset_rollouts": 4}}}

    assert experiment(settings) == {"actors": 2, "actor.envs": 9, "learner.intake.dataset_rollouts": 4}


def observing(**options):
    return {"observation": {"critic": "privileged"} | options}


def test_groups_are_named_by_their_differences():
    usual = {"spin": "estimated", "prediction": True, "age": True}
    first_3 = {"curriculum": {"first_stage": 3}}
    groups = group(
        [
            make_run("a", task=observing()),
            make_run("b", task=observing(), learner=first_3),
            make_run("c", task=observing() | {"collision": "original"}),
            make_run("d", task=observing(critic="policy", history=8, spin="true")),
            make_run("e", task=observing(critic="policy", spin="estimated", age=True)),
            make_run("f", task=observing(prediction=True)),
            make_run("g", task=observing(**usual)),
            make_run("h", task=observing(ball="filtered")),
            make_run("i", task=observing(ball="filtered", **usual)),
            make_run("j", task=observing(), experience={"teacher": {"policy": "common/policies/default"}}),
        ]
    )

    assert [one.label for one in groups] == [
        "stages 1+2+3, 37 numbers",
        "stage 3 only, 37 numbers",
        "stages 1+2+3, original collisions, 37 numbers",
        "stages 1+2+3, history 8 + true spin, critic observes no more",
        "stages 1+2+3, estimated spin + sample age, critic observes no more",
        "stages 1+2+3, prediction",
        "stages 1+2+3",
        "stages 1+2+3, 37 numbers, ball filtered",
        "stages 1+2+3, ball filtered",
        "stages 1+2+3, distilled from default, 37 numbers",
    ]
    assert groups[0].description == (
        "stages 1+2+3, tailored collisions, observes 37 numbers, critic observes the truth"
    )


@pytest.mark.parametrize(
    ("actors", "rollouts", "frames"), [(2, 0, 2048), (64, 0, 8192), (64, 16, 2048), (64, 32, 4096)]
)
def test_a_minibatch_by_default_is_the_one_that_was_set(actors, rollouts, frames):
    """64 actors have 16 environments each, and 32,768 frames a dataset."""

    def settings(minibatch):
        learner = {"ppo": {"minibatch": minibatch}, "intake": {"dataset_rollouts": rollouts}}
        return {"actors": actors, "actor": {"horizon": 32}, "learner": learner}

    assert experiment(settings(0)) == experiment(settings(frames))


def test_experiments_of_one_name_are_distinguished_by_the_settings_that_differ():
    runs = [
        make_run(name, learner={"ppo": {"clip": clip, "gamma": 0.99}})
        for name, clip in (("a", 0.2), ("b", 0.1))
    ]

    assert [one.label for one in group(runs)] == ["stages 1+2+3, clip 0.2", "stages 1+2+3, clip 0.1"]


# ---- commands


def test_a_command_is_the_settings_that_are_not_the_defaults():
    units = list(NetworkConfig().units)
    settings = {
        "run": "a b",
        "actors": 4,
        "seed": 0,
        "endpoint": "tcp/1",
        "local": {"panel": "off", "evaluate": False},
        "task": {"randomization": "standard"},
        "learner": {"ppo": {"clip": 0.1}},
        "network": {"units": units},
    }

    assert command_of("a b", settings) == (
        "topspin train --run 'a b' --actors 4 --evaluate false --learner.ppo.clip 0.1"
    )


def test_a_command_gives_the_settings_it_was_made_from():
    argv = "--run n --actors 3 --task.observation.history 8 --network.units 64,32 --learner.curriculum.first-stage 3"
    config = load(DeployConfig, argv.split(), prog="p", section="local", environ={})

    found = command_of("n", to_tables(config, "local"))

    again = load(DeployConfig, found.split()[2:], prog="p", section="local", environ={})
    assert again == config
    assert sorted(found.split()[2:]) == sorted(argv.split())


def test_a_command_with_a_recipe_keeps_what_was_set_back_to_the_defaults(tmp_path):
    argv = "--run n --recipe paper --task.control-rate-hz 50 --task.reward.landing-bonus 100.0"
    (tmp_path / "own.toml").write_text("[learner.ppo]\nclip = 0.1\n")

    def settings_of(words):
        return load(DeployConfig, words, prog="p", section="local", environ={}, recipes=RECIPES)

    config = settings_of(argv.split())
    found = command_of("n", to_tables(config, "local"))
    of_file = command_of("n", to_tables(settings_of(["--recipe", str(tmp_path / "own.toml")]), "local"))

    assert settings_of(found.split()[2:]) == config
    assert sorted(found.split()[2:]) == sorted(argv.split())
    assert of_file == "topspin train --run n --learner.ppo.clip 0.1"


# ---- the command line


def test_words_that_are_neither_flags_nor_their_values_are_runs():
    config = settings(["a", "--rallies", "5", "b", "--rounds-too", "c", "--out", "o"])

    assert (config.runs, config.rallies, config.rounds_too, config.out) == (("a", "b", "c"), 5, True, "o")


@pytest.mark.parametrize("word", ["true", "false"])
def test_a_switch_may_have_its_value_behind_it(word):
    config = settings(["a", "--rounds-too", word, "b"])

    assert (config.runs, config.rounds_too) == (("a", "b"), word == "true")


def test_no_run_and_unknown_flags_are_errors_and_help_is_real():
    with pytest.raises(ConfigError, match="no run to report on"):
        settings([])
    with pytest.raises(ConfigError, match="unknown flag --ralies; did you mean '--rallies'"):
        settings(["a", "--ralies", "5"])
    with pytest.raises(HelpRequest, match=r"report RUN\.\.\.(.|\n)*--rallies +rallies to play"):
        settings(["--help"])


def test_without_its_libraries_a_report_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "topspin.report.figures", None)
    monkeypatch.delattr(report, "figures", raising=False)  # where an earlier test has imported it

    with pytest.raises(ReportedError, match=r"pip install -e '\.\[report\]'"):
        command.main([str(write_run(tmp_path, "a"))], Event())


def test_a_policy_that_can_not_be_measured_so_is_refused_before_any_rally(tmp_path, monkeypatch):
    """An expected spin has no effect on a policy that observes neither spin nor prediction."""
    played = []
    monkeypatch.setattr(results_module, "play_match", lambda *arguments: played.append(arguments))
    runs = [read(str(write_run(tmp_path, name))) for name in "ab"]
    contract = runs[1].policy.contract
    blind = contract.task.model_copy(update={"observation": PAPER_OBSERVATION})
    policy = replace(runs[1].policy, contract=contract.model_copy(update={"task": blind}))

    with pytest.raises(PolicyError, match="expected"):
        results_module.results(
            [runs[0], replace(runs[1], policy=policy)], ReportConfig(expected_spin="strong")
        )

    assert played == []


def test_policies_are_measured_on_the_reports_task_not_their_training_task(tmp_path):
    policy = read(str(write_run(tmp_path, "a"))).policy

    task = evaluation_task(policy, ReportConfig(), 1)
    assert (task.randomization, task.collision, task.rounds) == ("standard", "tailored", 1)
    assert (task.control_rate_hz, task.flight) == (50, "full")
    assert task.observation == policy.contract.task.observation


def test_runs_of_unequal_length_or_of_one_seed_are_reported():
    def of(*frames_and_seeds, label="ours"):
        runs = tuple(
            RunResult(make_run(), seed, "", frames, None, None, None, {}, {})
            for frames, seed in frames_and_seeds
        )
        return GroupResult(label, "", runs, None, {}, {}, {}, {})

    assert not [*inequalities([of((10_000_000, 0), (10_002_432, 1), (None, 2))])]
    assert [*inequalities([of((10_000_000, 0), (60_000_000, 1)), of((5, 3), (5, 3))])] == [
        "ours: its runs are of different length, 10.0 to 60.0 M frames",
        "ours: several runs of seed 3",
    ]
    longer = of((15_000_000, 0), label="a"), of((120_000_000, 0), label="b")
    assert [*inequalities(longer)] == ["experiments are of different length, in M frames: a 15.0, b 120.0"]


def test_a_mean_of_policies_is_reported_as_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    best = write_run(tmp_path, "a") / "policy" / "best"
    policy = load_policy(best)
    mean = mean_policy([policy, policy])
    save_policy(best, mean.network, mean.moments, mean.contract)

    command.main(["a", "--rallies", "24", "--envs", "24", "--out", "o"], Event())

    page = (tmp_path / "o" / "report.md").read_text()
    assert "| **Topspin, stages 1+2 (1 seed, mean of 2 policies)** |" in page
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
    asked = one["runs"][1]["robot"]
    assert asked["name"] == "rails"
    assert set(asked["table_force_n_by_link"]) == set(asked["self_penetration_by_link"])
    assert found["missing"] == ["b: no epochs in metrics.csv: frames, hours and stages are unknown"]
    page = (tmp_path / "o" / "report.md").read_text()
    assert "| **Topspin, stages 1+2 (2 seeds)** | no |" in page
    assert "- b: no epochs in metrics.csv" in page
    assert "## What it asked of the robot\n" in page
    assert re.search(r"\n\| a \| rails \| \d+\.\d\d % \| \d+\.\d\d % \| \d\.\d\d \(\w+\) \|", page)
    assert "## In words\n\nIt plays well | mostly.\n\nSecond <thing>.\n" in page
    written = next(line for line in page.splitlines() if line.startswith("topspin report "))
    assert written.startswith("topspin report a b --")
    assert settings(written.split()[2:]) == settings(["a", "b", *words[3:-2], "--note", "note.txt"])
    assert "topspin train --run b --seed 1" in page
    drawn = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert {"curves_frames.png", "landings.png", "courts.png", "rates.png", "rounds.png"} <= set(drawn)
    assert all((tmp_path / "o" / name).stat().st_size > 5000 for name in drawn)
    html = (tmp_path / "o" / "report.html").read_text()
    assert html.count("<img ") == len(drawn)
    assert "<p>Second &lt;thing&gt;.</p>" in html
    assert set(re.findall(r'(?:src|href)="(.{22})', html)) == {"data:image/png;base64,"}
    assert str(tmp_path) not in page + html + json.dumps(found)


def test_a_folder_that_cant_be_written_is_an_error_before_anything_is_played(tmp_path):
    (tmp_path / "file").write_text("")

    with pytest.raises(
        ConfigError, match=r"out = '.*file/report': Not a directory; allowed: a folder that can be"
    ):
        make_folder(tmp_path / "file" / "report")


def test_an_unreadable_note_is_an_error_before_anything_is_played(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "a")

    with pytest.raises(ReportedError, match=r"can't read the note no\.txt: No such file"):
        command.main(["a", "--note", "no.txt"], Event())
    assert not (tmp_path / "runs" / "report").exists()


def test_a_group_is_named_after_the_stages_that_were_trained():
    def trained(*stages, seed=0):
        frames = np.arange(len(stages), dtype=float)
        return replace(make_run(seed=seed), training=TrainingCurve(frames, frames, np.array(stages, float)))

    def name(*runs):
        (one,) = group(runs)
        return one.label

    assert name(trained(1, 1)) == "stage 1 only"
    assert name(trained(1, 1, 2)) == "stages 1+2"
    assert name(trained(1, 2, 3)) == name(make_run()) == "stages 1+2+3"
    assert name(trained(1), trained(1, 2, seed=1)) == "stages 1+2"  # each was reached by one of them


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_curve_of_one_point_is_drawn_as_a_point(seeds):
    curve = Curve(np.array([1e6]), np.array([2.0]), {name: np.array([0.5]) for name in CURVES})
    runs = tuple(
        RunResult(replace(make_run(), curve=curve), 0, "", None, None, None, None, {}, {})
        for _ in range(seeds)
    )
    one = GroupResult("one", "one", runs, None, {}, {}, {}, {})

    axes = curves([one], {one.label: "black"}, by_time=False).axes[1]

    drawn = [line for line in axes.lines if len(line.get_xdata()) == 1]
    assert [line.get_marker() for line in drawn] == ["o"] * seeds


def test_the_command_of_a_report_has_every_setting_that_is_not_the_default():
    words = [
        "runs/a",
        "--perception",
        "full",
        "--collision",
        "original",
        "--rounds-too",
        "--launch",
        "strong",
    ]
    given = settings([*words, "--out", "o", "--note", "a b"])

    again = settings(shlex.split(own_command(given))[2:])

    assert again.model_copy(update={"out": "o"}) == given


def test_two_runs_of_one_seed_are_one_value():
    runs = [a_result(seed, rate) for seed, rate in ((0, 0.2), (0, 0.4), (1, 0.5))]

    found = spread(runs, "return_rate")

    assert (found.seeds, found.lowest, found.highest) == (2, pytest.approx(0.3), 0.5)
    assert found.mean == pytest.approx(0.4)


def a_result(seed, rate):
    return SimpleNamespace(seed=seed, measures={"return_rate": rate})
