"""What finished runs reached, beside the paper's recipe: one rung for each way to train.

    python -m benchmarks.recipe --json                                      # the runs that the repository keeps
    python -m benchmarks.recipe runs/paper-0 runs/paper-1 runs/more-0 --json

It trains nothing. It reads each run's settings and the measure of its last weights (report/final.json; of a run that
ended without it, the last row of report/evaluations.csv). A rung is all runs of one label, and the label is what the
runs' settings differ in from recipe ``paper``.
"""

import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from threading import Event
from typing import Any, Final

from pydantic import Field

from benchmarks.settings import BenchmarkConfig, run
from benchmarks.trainings import KEPT, differences
from common.errors import ReportedError
from common.service.config import load, recipe_names, to_tables
from common.service.config_sources import read_toml
from common.service.process import DONE
from common.service.run_folder import RunFolder
from common.service.table import whole_rows
from deploy.config import RECIPES, SECTION, DeployConfig
from topspin.report.collect import find
from topspin.report.groups import experiment

BASE: Final = "paper"
OF_PAPER: Final = ("paper", "paper-50hz")  # recipes of the paper, by their control rate
KEPT_RUNS: Final = "recipe-*"  # in results/runs
FINAL: Final = "final"  # of a run that trained to its end
MEASURES: Final = ("return_rate", "return_after_catch", "target_error_mean")


class RecipeConfig(BenchmarkConfig):
    """Compare finished runs with the paper's recipe."""

    runs: tuple[str, ...] = Field(
        (),
        description="runs, by name or folder; words without a flag before them are runs too; empty: those of the "
        "recipes that benchmarks/results/runs has",
    )


def with_runs(argv: Sequence[str]) -> list[str]:
    """Return the flags, with words that are neither flags nor values of flags as ``--runs``."""
    flags, runs, words = list[str](), list[str](), list(argv)
    while words:
        word = words.pop(0)
        (flags if word.startswith("-") else runs).append(word)
        if word in ("--runs", "--config") and words:
            flags.append(words.pop(0))
    return flags + (["--runs", json.dumps(runs)] if runs else [])


def known_settings() -> dict[str, dict[str, Any]]:
    """Return the settings of each recipe and of the defaults, by name; the first is the base."""

    def of(recipe: str) -> dict[str, Any]:
        argv = ["--recipe", recipe] if recipe else []
        config = load(DeployConfig, argv, prog="recipe", section=SECTION, environ={}, recipes=RECIPES)
        return experiment(to_tables(config, SECTION))

    names = sorted(recipe_names(RECIPES), key=lambda name: name != BASE)
    return {**{name: of(name) for name in names}, "default": of("")}


def label(settings: Mapping[str, Any], known: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the name of the recipe that a run's settings are, or how they differ from the base.

    Args:
        settings: The run's config.toml.
        known: Settings by name; the first is the base.
    """
    own = experiment(settings)
    name = next((name for name, theirs in known.items() if not differences(own, theirs)), "")
    base, theirs = next(iter(known.items()))
    return name or f"{base} with {', '.join(differences(own, theirs))}"


def result(folder: RunFolder) -> dict[str, Any]:
    """Return the measures of a finished run's last weights, under the contacts of its training.

    Raises:
        ReportedError: It has none.
    """
    name = folder.root.name
    measured = FINAL
    try:
        found = json.loads(folder.final.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = {}
    if "return_rate" not in found:
        rows = whole_rows(folder.evaluations)
        if not rows:
            raise ReportedError(
                f"run {name!r} is not measured: neither report/{folder.final.name} nor "
                f"report/{folder.evaluations.name} has its rates; let it train to its end"
            )
        measured, found = "last evaluation", dict(rows[-1])
    return {
        "run": name,
        "seed": read_toml(folder.config).get("seed", 0),
        "frames": int(float(found["frames"])),
        **{key: _number(found.get(key)) for key in MEASURES},
        "measured": measured,
        "collision": found.get("collision"),
    }


def _number(value: Any) -> float | None:
    return None if value in (None, "") else float(value)


def rungs(folders: Sequence[RunFolder]) -> dict[str, Any]:
    """Return the runs of the paper's recipes, and all runs by label with the medians of the measures: theirs first."""
    known = known_settings()
    by_label: dict[str, list[dict[str, Any]]] = {name: [] for name in OF_PAPER}
    for folder in folders:
        by_label.setdefault(label(read_toml(folder.config), known), []).append(result(folder))
    ladder = [
        {"label": name, "runs": runs, "median": medians(runs)} for name, runs in by_label.items() if runs
    ]
    return {BASE: [{"recipe": name} | run for name in OF_PAPER for run in by_label[name]], "ladder": ladder}


def median(runs: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Return the median of one measure over the runs that ended and have it, or None."""
    values = [run[key] for run in runs if run[key] is not None and run["measured"] == FINAL]
    return round(statistics.median(values), 4) if values else None


def medians(runs: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Return the median of each measure over the runs."""
    return {key: median(runs, key) for key in MEASURES}


def main(config: RecipeConfig, stop: Event) -> int:
    """Print the rungs and return the exit status."""
    del stop  # it reads a few files
    runs = config.runs or sorted(str(path) for path in KEPT.glob(KEPT_RUNS))
    if not runs:
        raise ReportedError(
            "no run to compare; give folders, as in: python -m benchmarks.recipe runs/paper-0"
        )
    folders = {folder.root: folder for folder in map(find, runs)}  # each once, under whatever names
    found = rungs(list(folders.values()))
    if config.json_line:
        print(json.dumps(found))
        return DONE
    for rung in found["ladder"]:
        print(rung["label"])
        for one in (
            *rung["runs"],
            {"run": "median", "seed": "", "frames": "", "measured": "", **rung["median"]},
        ):
            print(
                "  "
                + "  ".join(f"{one[key]!s:>20}" for key in ("run", "seed", "frames", *MEASURES, "measured"))
            )
    return DONE


if __name__ == "__main__":
    sys.exit(run("recipe", RecipeConfig, main, with_runs(sys.argv[1:])))
