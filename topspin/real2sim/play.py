"""Recordings of real balls, played with a policy: what is measured, and the files that are written."""

import logging
import time
from pathlib import Path
from threading import Event
from types import ModuleType
from typing import Any, Final

import numpy as np

from common.errors import ReportedError
from common.evaluation.breakdown import breakdown
from common.evaluation.evaluate import check
from common.evaluation.match import match_task, play_match
from common.evaluation.measures import MatchResult, measures
from common.evaluation.printed import print_measures
from common.evaluation.rally_recorder import RecordedRally, record_rallies
from common.policy.box import policy_folder
from common.policy.contract import Contract
from common.policy.folder import load_policy
from common.service.process import DONE
from common.task.config import TaskConfig
from topspin.real2sim.config import Real2SimConfig
from topspin.real2sim.dataset import Recorded, evenly, read
from topspin.real2sim.formats.tracks import RecordingError
from topspin.real2sim.printed import lines
from topspin.render.film import check_tools, film

log = logging.getLogger(__name__)

FILM_NAME: Final = "rallies.mp4"


def run(config: Real2SimConfig, stop: Event) -> int:
    """Play, measure, print, and write the requested files; return the exit status."""

    def on_tick() -> None:
        check(stop)

    started = time.monotonic()
    video = video_of(config)
    page = _page() if config.out else None  # raises before anything is played if a library is missing
    if video is not None:
        check_tools(video)
    folder = policy_folder(config.policy)
    policy = load_policy(folder)
    task = task_of(policy.contract, config)

    recorded = read(config, task.flight_model, on_tick)
    try:
        block = recorded.rallies.block()
    except RecordingError:
        if config.json_line:
            print_measures(without_rallies(recorded, config), as_json=True)
        raise
    opponents = recorded.opponents(task.observation.is_tracked and task.observation.expected_spin == "learnt")
    log.info("playing rallies=%d of=%d mode=%s", len(block.seeds), len(recorded.tracks), config.mode)
    played = play_match(policy, block, task, config.envs, on_tick, opponents)
    found = measured(recorded, played, config) | {
        "expected_spin": task.observation.expected_spin,
        "opponents": len(np.unique(opponents)),
        "policy": str(folder),
    }

    shown = evenly(len(block.seeds), config.shown) if config.out and config.shown else evenly(0, 0)
    filmed = evenly(len(block.seeds), config.film_rallies) if video is not None else evenly(0, 0)
    rows = sorted({*shown.tolist(), *filmed.tolist()})
    again: dict[int, RecordedRally] = {}
    if rows:  # played again, from home, since a match records no flights
        again = dict(zip(rows, record_rallies(policy.act, block.of(np.array(rows)), task), strict=True))
    if video is not None:
        found["video"] = str(video)
        note = (
            f"recorded balls, randomization {config.randomization}, perception {config.perception}, each played again "
            "from home"
        )
        film(video, [again[k] for k in filmed.tolist()], config, note, on_tick)
    found["seconds"] = round(time.monotonic() - started, 2)
    if page is not None:
        found["report"] = str(Path(config.out) / "report.md")
        page.write(found, played, recorded, {k: again[k] for k in shown.tolist()}, Path(config.out))
    print_measures(found, config.json_line, lines)
    return DONE


def video_of(config: Real2SimConfig) -> Path | None:
    """Return the path of the film, or None if none is written."""
    if not config.film_rallies or not (config.video or config.out):
        return None
    return Path(config.video) if config.video else Path(config.out) / FILM_NAME


def task_of(contract: Contract, config: Real2SimConfig) -> TaskConfig:
    """Return the task in which recordings are played.

    Every ball meets a robot that starts near its home (``carry_over`` 0): a recording says nothing of the stroke
    before, and so its rally does not depend on the others.
    """
    task = match_task(contract, config, config.expected_spin)
    return task.model_copy(update={"rounds": 1, "collision": "tailored", "carry_over": 0.0})


def _left_out(recorded: Recorded, config: Real2SimConfig) -> dict[str, Any]:
    valid = recorded.rallies.valid
    return {
        "data": config.data,
        "recordings": len(valid),
        "dropped": dict(recorded.dropped),
        "skipped": dict(recorded.skipped),
        "valid_share": round(float(valid.mean()), 4),
        "invalid": recorded.rallies.invalid,
    }


def without_rallies(recorded: Recorded, config: Real2SimConfig) -> dict[str, Any]:
    """Return what there is to say if no recording is a valid rally, ready for JSON."""
    return _left_out(recorded, config) | recorded.fit_summary() | {"rallies": 0, "mode": config.mode}


def measured(recorded: Recorded, played: MatchResult, config: Real2SimConfig) -> dict[str, Any]:
    """Return the match's conditions and measures, ready for JSON."""
    by = breakdown(played)
    return (
        _left_out(recorded, config)
        | recorded.fit_summary()
        | measures(played)
        | {
            "by_speed": by["speed"],
            "by_spin": by["spin"],
            "by_spin_kind": by["spin_kind"],
            "mode": config.mode,
            "perception": config.perception,
            "randomization": config.randomization,
            "seed": config.seed,
        }
    )


def _page() -> ModuleType:
    """Return the module that writes the report; raises ReportedError where its libraries aren't installed."""
    try:
        from topspin.real2sim import page  # noqa: PLC0415 - an extra that measuring does not need
    except ModuleNotFoundError as error:
        raise ReportedError(f"a report needs {error.name}: pip install -e '.[report]'") from None
    return page
