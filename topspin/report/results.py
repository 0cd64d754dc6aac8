"""Every number of a report: each run's measures, those of its group, and their provenance."""

import dataclasses
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

import numpy as np

from common.evaluation.breakdown import breakdown, survival
from common.evaluation.match import evaluation_rallies, match_task, play_match
from common.evaluation.measures import MatchResult, measures
from common.evaluation.robot_measures import robot_part
from common.policy.folder import Policy
from common.task.config import TaskConfig
from common.task.launch import RallyBlock
from topspin.report.collect import CURVES, Curve, Run
from topspin.report.config import ReportConfig
from topspin.report.groups import Group, group
from topspin.report.provenance import command, machine, versions

log = logging.getLogger(__name__)

ROUNDS: Final = 5  # rallies per episode, with rounds_too
UNEQUAL: Final = 1.1  # [-] runs of one experiment whose frames differ by a larger factor are reported
FIGURES: Final = (
    "catch_rate",
    "over_rate",
    "return_rate",
    "return_after_catch",
    "target_error_mean",
    "target_error_median",
    "within_0.2_m",
    "within_0.3_m",
    "rally_length_mean",
)
"""Measures whose mean and spread over the seeds are reported."""


@dataclass(frozen=True, slots=True)
class Spread:
    """One measure over a group's seeds."""

    mean: float
    deviation: float | None  # sample standard deviation; None for a single seed
    lowest: float
    highest: float
    seeds: int


@dataclass(frozen=True, slots=True)
class RunResult:
    """Results of a run."""

    run: Run
    seed: int
    command: str
    frames: int | None  # trained
    seconds: float | None  # trained
    played: MatchResult | None  # None: it has no policy to play
    went_on: MatchResult | None  # the same with ROUNDS rallies per episode; None: not played
    measures: Mapping[str, Any]
    robot: Mapping[str, Any]  # what it asked of the robot; {}: not played


@dataclass(frozen=True, slots=True)
class GroupResult:
    """Results of a group's seeds together."""

    label: str
    description: str
    runs: tuple[RunResult, ...]
    played: MatchResult | None  # all seeds' rallies
    pooled: Mapping[str, Any]  # measures of all seeds' rallies as one
    spread: Mapping[str, Spread]  # by name, of FIGURES
    by: Mapping[str, Any]  # breakdown of all seeds' rallies
    survival: Mapping[str, Any]  # breakdown.survival of all seeds' rallies; {}: not played

    @property
    def seeds(self) -> tuple[int, ...]:
        """Return the seeds in order."""
        return tuple(result.seed for result in self.runs)

    @property
    def curves(self) -> list[Curve]:
        """Return the training curves of the seeds that have one."""
        return [result.run.curve for result in self.runs if result.run.curve is not None]


@dataclass(frozen=True, slots=True)
class Results:
    """Everything on the page."""

    groups: tuple[GroupResult, ...]
    settings: ReportConfig
    versions: Mapping[str, str]
    machine: Mapping[str, str]
    missing: tuple[str, ...]  # what is missing, and why figures are not comparable, in words


def evaluation_task(policy: Policy, config: ReportConfig, rounds: int) -> TaskConfig:
    """Return the task that a policy is measured on: its contract's, under the report's conditions."""
    task = match_task(policy.contract, config, config.expected_spin)
    return task.model_copy(update={"rounds": rounds})


def results(runs: Sequence[Run], config: ReportConfig, on_tick: Callable[[], None] = lambda: None) -> Results:
    """Return the runs' results: plays their policies, all on the same rallies.

    Args:
        runs: As read from their folders.
        config: Settings.
        on_tick: Called between control steps; may raise.

    Raises:
        PolicyError: A policy can't play under the report's conditions.
    """
    for run in runs:  # a policy that can't be measured so is refused before hours of play
        if run.policy is not None:
            evaluation_task(run.policy, config, config.rounds)
    rallies = evaluation_rallies(config.rallies, TaskConfig().under(config), config.seed)
    groups = tuple(
        _of_group(one, [_of_run(run, config, rallies, on_tick) for run in one.runs]) for one in group(runs)
    )
    missing = tuple(f"{run.name}: {what}" for run in runs for what in run.missing)
    return Results(groups, config, versions(), machine(), missing + tuple(inequalities(groups)))


def _of_run(
    run: Run,
    config: ReportConfig,
    rallies: RallyBlock,
    on_tick: Callable[[], None],
) -> RunResult:
    played, went_on, found, robot = None, None, dict[str, Any](), dict[str, Any]()
    if run.policy is not None:
        log.info("playing run=%s policy=%s rallies=%d", run.name, config.policy, config.rallies)
        played = play_match(
            run.policy, rallies, evaluation_task(run.policy, config, config.rounds), config.envs, on_tick
        )
        found = measures(played)
        robot = robot_part(played.robot, run.policy.contract.task.robot).get("robot", {})
        if config.rounds_too:
            task = evaluation_task(run.policy, config, ROUNDS)
            went_on = play_match(run.policy, rallies, task, config.envs, on_tick)
            found["rally_length_mean"] = survival(went_on)["rally_length_mean"]
    trained = run.training
    return RunResult(
        run=run,
        seed=int(run.settings.get("seed", 0)),
        command=command(run.name, run.settings),
        frames=int(trained.frames[-1]) if trained else None,
        seconds=float(trained.seconds[-1]) if trained else None,
        played=played,
        went_on=went_on,
        measures=found,
        robot=robot,
    )


def _of_group(one: Group, runs: Sequence[RunResult]) -> GroupResult:
    played = _pooled([result.played for result in runs])
    went_on = _pooled([result.went_on for result in runs])
    return GroupResult(
        label=one.label,
        description=one.description,
        runs=tuple(sorted(runs, key=lambda result: result.seed)),
        played=played,
        pooled=measures(played) if played is not None else {},
        spread={name: found for name in FIGURES if (found := spread(runs, name)) is not None},
        by=breakdown(played) if played is not None else {},
        survival=survival(went_on) if went_on is not None else {},
    )


def inequalities(groups: Sequence[GroupResult]) -> Iterator[str]:
    """Return in words why runs are not comparable seeds of one experiment, or experiments of one length."""
    for one in groups:
        frames = [result.frames for result in one.runs if result.frames]
        if _are_unequal(frames):
            longest, shortest = max(frames) / 1e6, min(frames) / 1e6
            yield f"{one.label}: its runs are of different length, {shortest:.1f} to {longest:.1f} M frames"
        twice = sorted({seed for seed in one.seeds if one.seeds.count(seed) > 1})
        if twice:
            yield f"{one.label}: several runs of seed {', '.join(map(str, twice))}"
    lengths = {
        one.label: median(found) for one in groups if (found := [r.frames for r in one.runs if r.frames])
    }
    if _are_unequal(list(lengths.values())):
        each = ", ".join(f"{label} {frames / 1e6:.1f}" for label, frames in lengths.items())
        yield f"experiments are of different length, in M frames: {each}"


def _are_unequal(frames: Sequence[float]) -> bool:
    return bool(frames) and max(frames) > UNEQUAL * min(frames)


def mean_of(policy: Policy | None) -> tuple[str, ...]:
    """Return the runs that a policy is the mean of; () for a policy of one run."""
    parts = policy.contract.made_with.get("mean_of", "") if policy is not None else ""
    return tuple(parts.split("; ")) if parts else ()


def _pooled(parts: Sequence[MatchResult | None]) -> MatchResult | None:
    played = [part for part in parts if part is not None]
    return MatchResult.together(played) if played else None


def spread(runs: Sequence[RunResult], name: str) -> Spread | None:
    """Return one measure over the seeds that have it, or None if none does."""
    values = list(by_seed(runs, name).values())
    if not values:
        return None
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Spread(float(np.mean(values)), deviation, min(values), max(values), len(values))


def by_seed(runs: Sequence[RunResult], measure: str) -> dict[int, float]:
    """Return one measure of each seed that has it: the mean of the runs of that seed."""
    values: dict[int, list[float]] = {}
    for run in runs:
        if (value := run.measures.get(measure)) is not None:
            values.setdefault(run.seed, []).append(float(value))
    return {seed: float(np.mean(of_seed)) for seed, of_seed in values.items()}


def as_json(found: Results) -> dict[str, Any]:
    """Return every number, ready for JSON."""
    return {
        "settings": found.settings.model_dump(mode="json"),
        "versions": dict(found.versions),
        "machine": dict(found.machine),
        "missing": list(found.missing),
        "groups": [_group_json(one) for one in found.groups],
    }


def _group_json(one: GroupResult) -> dict[str, Any]:
    return {
        "label": one.label,
        "description": one.description,
        "seeds": list(one.seeds),
        "pooled": dict(one.pooled),
        "over_seeds": {
            name: {k: _rounded(v) for k, v in dataclasses.asdict(found).items()}
            for name, found in one.spread.items()
        },
        "by": dict(one.by),
        "survival": dict(one.survival),
        "runs": [_run_json(result) for result in one.runs],
    }


def _run_json(result: RunResult) -> dict[str, Any]:
    run, policy = result.run, result.run.policy
    of_policy = {} if policy is None else {
        name: getattr(policy.contract, name) for name in ("generation", "version", "stage", "frames")
    } | {"end_to_end": policy.contract.is_end_to_end}  # fmt: skip
    return {
        "run": run.name,
        "seed": result.seed,
        "command": result.command,
        "frames": result.frames,
        "seconds": result.seconds,
        "stage_changes": [list(change) for change in run.training.stage_changes()] if run.training else [],
        "policy": of_policy | {"mean_of": list(mean_of(policy))},
        "measures": dict(result.measures),
        "robot": dict(result.robot),
        "by": breakdown(result.played) if result.played is not None else {},
        "survival": survival(result.went_on) if result.went_on is not None else {},
        "curve": _curve_json(run.curve) if run.curve is not None else {},
    }


def _curve_json(curve: Curve) -> dict[str, list[float | None]]:
    columns = {"frames": curve.frames, "minutes": curve.minutes} | {
        name: curve.values[name] for name in CURVES
    }
    return {name: [_rounded(float(value)) for value in values] for name, values in columns.items()}


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    return value
