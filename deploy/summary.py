"""What a run leaves, in a few lines: its result, and the commands that people type next."""

import logging
import shlex
from collections.abc import Mapping
from threading import Event
from typing import Any

from common.comms.messages import FATES, Status
from common.errors import StoppedError
from common.evaluation.config import MatchConfig
from common.evaluation.evaluate import check, measure
from common.policy.folder import load_policy
from common.service.run_folder import RunFolder
from deploy.history import STAGES
from deploy.panel import written
from deploy.prepare import PreparedRun, last_epoch

log = logging.getLogger(__name__)


def run_summary(run: PreparedRun, learner: Status | None) -> dict[str, Any]:
    """Return a run's summary, from its folder and from the learner's last heartbeat."""
    contract = load_policy(run.folder.latest_policy).contract
    counters = learner.counters if learner else {}
    return {
        "run": run.name,
        "policy": str(run.folder.latest_policy),
        "frames": contract.frames,
        "stage": contract.stage,
        "seconds": trained_seconds(run.folder),
        "ledger": {name: int(counters[name]) for name in FATES if name in counters},
    }


def trained_seconds(folder: RunFolder) -> float:
    """Return the time from the first trained batch to the last, through restarts [s]."""
    return round(float(last_epoch(folder).get("seconds", 0.0)), 1)


def final_measures(run: PreparedRun, stop: Event) -> dict[str, Any]:
    """Return the measures of the final policy; {} if a stop was requested.

    Launch preset and randomization are the same for every run; contacts and perception are the run's.
    """
    folder, task = run.folder.latest_policy, run.config.task
    config = MatchConfig(
        rallies=run.config.final_rallies,
        seed=run.config.seed,
        envs=run.config.evaluator.envs,
        rounds=run.config.evaluator.rounds,
        perception=task.perception,
        collision=task.collision,
        time_limit_s=task.time_limit_s,
    )
    log.info("measuring the final policy rallies=%d", config.rallies)
    try:
        measured = measure(load_policy(folder), folder, config, lambda: check(stop))
    except StoppedError:
        return {}
    for detail in ("policy", "by", "by_round"):
        measured.pop(detail, None)
    measured["evaluation_seconds"] = measured.pop("seconds")
    return measured


def table(found: Mapping[str, Any], folder: RunFolder) -> str:
    """Return a run's result for a person: a row for each figure, with an empty line at the end."""
    ledger = found["ledger"]
    fates = "   ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in ledger.items())
    rows = [
        ("stage", STAGES[found["stage"]]),
        ("trained", f"{found['frames']:,} frames, {found['seconds'] / 60.0:.1f} min"),
        ("rollouts", fates or "none"),
        ("run folder", str(folder.root)),
    ]
    if "return_rate" in found:
        error = {"error": found["target_error_mean"]} if found["target_error_mean"] is not None else {}
        rows[1:1] = [
            (
                "return rate",
                f"{written(found, 'return_rate', '.1f', ' %', 100.0)} of {found['rallies']:,} rallies",
            ),
            ("target error", written(error, "error", ".2f", " m")),
        ]
    width = max(len(name) for name, _ in rows)
    return "\n".join([f"run {found['run']}", *(f"  {name:{width}}  {text}" for name, text in rows), "", ""])


def next_commands(run: PreparedRun, prog: str) -> str:
    """Return how to film, go on with and report a run, as commands; the first one that fits its state."""
    name, folder = shlex.quote(run.name), run.folder
    has_best = folder.best_policy.is_dir()
    policy = folder.best_policy if has_best else folder.latest_policy
    commands = (
        (
            "film",
            f"topspin play --policy {shlex.quote(str(policy))} --video {shlex.quote(str(folder.root))}.mp4",
        ),
        ("go on", f"{prog} --run {name} --resume{more(run)}"),
        ("report", f"topspin report {name}{'' if has_best else ' --policy latest'}"),
    )
    return "next\n" + "".join(f"  {what:6}  {command}\n" for what, command in commands)


def more(run: PreparedRun) -> str:
    """Return the flags that give a run whose budget is spent twice as much of it; "" where some is left."""
    config = run.config
    spent = run.spent_by(last_epoch(run.folder))
    if spent.endswith("minutes"):
        return f" --minutes {2 * config.minutes:g}"
    curriculum = config.learner.curriculum
    if spent.endswith("frames"):
        twice = 2 * config.frames
        short = 0 if curriculum.frames is None else max(twice - curriculum.frames, 0)
        longer = f" --learner.curriculum.stage-3 {curriculum.stage_3 + short}" if short else ""
        return f" --frames {twice}{longer}"
    return f" --learner.curriculum.stage-3 {2 * curriculum.stage_3}" if spent else ""
