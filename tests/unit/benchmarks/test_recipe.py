"""The ladder of finished runs, from small run folders."""

import json
import shutil
import tomllib
from pathlib import Path
from threading import Event

import pytest

from benchmarks import recipe
from benchmarks.recipe import RecipeConfig, known_settings, label, main, rungs, with_runs
from common.errors import ReportedError
from common.service.config import save_settings, to_tables
from common.service.run_folder import RunFolder
from deploy.config import settings

FINAL = {"return_rate": 0.5, "return_after_catch": 0.6, "target_error_mean": 0.4, "frames": 1000}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recipe, "KEPT", tmp_path / "kept")


def finished(name, *flags, final=FINAL, evaluations=""):
    """Write the folder of a run that ended, with its settings as `topspin train` writes them."""
    folder = RunFolder.of(name)
    folder.create()
    config = settings(("--run", name, *flags), "p")
    save_settings(folder.config, to_tables(config, "local"))
    if final:
        folder.final.write_text(json.dumps(final))
    if evaluations:
        folder.evaluations.write_text(evaluations)
    return folder


def test_runs_of_the_recipe_are_one_rung_whatever_their_seed_and_length():
    found = rungs(
        [
            finished("a", "--recipe", "paper", final=FINAL | {"return_rate": 0.7}),
            finished("b", "--recipe", "paper", "--seed", "1", "--frames", "2000"),
            finished(
                "c",
                "--recipe",
                "paper",
                "--actors",
                "2",
                "--actor.envs",
                "736",
                "--seed",
                "2",
                final=FINAL | {"target_error_mean": None},
            ),
        ]
    )

    assert [(run["run"], run["seed"], run["return_rate"]) for run in found["paper"]] == [
        ("a", 0, 0.7),
        ("b", 1, 0.5),
        ("c", 2, 0.5),
    ]
    assert set(found["paper"][0]) == {
        *(
            "recipe",
            "run",
            "seed",
            "frames",
            "return_rate",
            "return_after_catch",
            "target_error_mean",
            "measured",
            "collision",
        )
    }
    assert [rung["label"] for rung in found["ladder"]] == ["paper"]
    assert found["ladder"][0]["median"] == {
        "return_rate": 0.5,
        "return_after_catch": 0.6,
        "target_error_mean": 0.4,
    }


def test_other_runs_are_grouped_by_what_their_settings_differ_in():
    clip = ("--recipe", "paper", "--learner.ppo.clip", "0.1")
    found = rungs(
        [
            finished("a"),
            finished("b", *clip, "--experience.leads-home", "true"),
            finished("c", *clip),
            finished("d", *clip, "--seed", "1"),
            finished("e", "--recipe", "paper-50hz"),
            finished("f", "--recipe", "paper"),
        ]
    )

    assert {rung["label"]: [run["run"] for run in rung["runs"]] for rung in found["ladder"]} == {
        "paper": ["f"],
        "default": ["a"],
        "paper with experience.leads_home true, learner.ppo.clip 0.1": ["b"],
        "paper with learner.ppo.clip 0.1": ["c", "d"],
        "paper-50hz": ["e"],
    }
    assert found["ladder"][0]["label"] == "paper"


def test_the_learners_record_of_its_settings_does_not_change_the_label():
    from services.learner.config import LearnerConfig

    folder = finished("a", "--recipe", "paper")
    config = settings(("--run", "a", "--recipe", "paper"), "p")
    shared = config.learner.model_dump() | config.model_dump(
        include={"task", "experience", "network", "frames"}
    )
    save_settings(folder.config, to_tables(LearnerConfig(run="a", **shared), "learner"))

    assert rungs([folder])["ladder"][0]["label"] == "paper"


def test_a_run_that_was_not_measured_at_its_end_has_its_last_evaluation():
    rows = "version,frames,return_rate,return_after_catch,target_error_mean\n1,500,0.1,0.2,0.9\n2,900,0.25,0.5,\n"
    run = rungs([finished("a", "--recipe", "paper", final={"frames": 1000}, evaluations=rows)])["paper"][0]

    assert run == {
        "recipe": "paper",
        "run": "a",
        "seed": 0,
        "frames": 900,
        "return_rate": 0.25,
        "return_after_catch": 0.5,
        "target_error_mean": None,
        "measured": "last evaluation",
        "collision": None,  # an evaluation does not say
    }


def test_a_run_without_measures_is_named():
    with pytest.raises(ReportedError, match=r"run 'a' is not measured: neither report/final\.json nor"):
        rungs([finished("a", final=None)])


def test_a_setting_that_the_run_lacks_is_a_difference():
    known = known_settings()

    assert label({}, known).startswith("paper with actor.horizon unset, actor.outbox.give_up_s unset")


def test_the_line_is_json(capsys):
    finished("a", "--recipe", "paper")

    assert main(RecipeConfig(runs=("runs/a",), json_line=True), Event()) == 0
    assert json.loads(capsys.readouterr().out)["paper"][0]["run"] == "a"
    main(RecipeConfig(runs=("a",)), Event())
    assert "median" in capsys.readouterr().out


def test_without_a_run_there_is_nothing_to_compare():
    with pytest.raises(ReportedError, match="no run to compare; give folders"):
        main(RecipeConfig(), Event())


def test_words_without_a_flag_are_runs():
    assert with_runs(["a", "--json", "b"]) == ["--json", "--runs", '["a", "b"]']
    assert with_runs(["--config", "x.toml"]) == ["--config", "x.toml"]


def test_a_run_that_was_stopped_is_shown_and_not_in_the_median():
    header = "frames,return_rate,return_after_catch,target_error_mean"
    found = rungs(
        [
            finished("a", "--recipe", "paper"),
            finished("b", "--recipe", "paper", final={}, evaluations=f"{header}\n900,0.9,0.9,0.1\n"),
        ]
    )

    assert [run["measured"] for run in found["paper"]] == ["final", "last evaluation"]
    assert found["ladder"][0]["median"]["return_rate"] == 0.5


def test_a_run_that_is_given_by_name_and_by_folder_counts_once(capsys):
    finished("a", "--recipe", "paper")
    main(RecipeConfig(runs=("a", "runs/a"), json_line=True), Event())

    assert len(json.loads(capsys.readouterr().out)["paper"]) == 1


def test_without_runs_those_of_the_repository_are_compared(capsys):
    shutil.copytree(finished("recipe-50hz-1", "--recipe", "paper-50hz").root, recipe.KEPT / "recipe-50hz-1")
    shutil.copytree(finished("ladder-1-1").root, recipe.KEPT / "ladder-1-1")
    main(RecipeConfig(json_line=True), Event())

    (only,) = json.loads(capsys.readouterr().out)["paper"]
    assert (only["recipe"], only["run"], only["return_rate"]) == ("paper-50hz", "recipe-50hz-1", 0.5)


def test_the_repositorys_runs_of_the_recipes_are_what_their_names_say():
    kept = sorted((Path(__file__).parents[3] / "benchmarks" / "results" / "runs").glob("recipe-*"))
    assert kept
    known = known_settings()
    for folder in kept:
        rate, seed = folder.name.removeprefix("recipe-").split("-")
        run = tomllib.loads((folder / "config.toml").read_text(encoding="utf-8"))
        if rate == "quarter":  # of the learning rate, and of the frames
            own = run["learner"]["ppo"]
            assert (own.pop("learning_rate"), own.pop("learning_rate_min")) == (1.25e-4, 1.25e-5)
            own |= {"learning_rate": 5e-4, "learning_rate_min": 5e-5}
            assert (label(run, known), run["frames"]) == ("paper-50hz", 15_000_000)
        else:
            assert label(run, known) == {"50hz": "paper-50hz", "200hz": "paper"}[rate]
            assert run["frames"] == 60_000_000
        assert run["seed"] == int(seed)
