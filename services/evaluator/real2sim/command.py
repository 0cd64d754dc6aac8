"""`python -m services.evaluator real2sim --data PATH`: play recordings of real balls with a policy."""

import json
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from types import ModuleType
from typing import Any, Final

import numpy as np

from common.config import ConfigError, load
from common.env.rally_env import EnvConfig
from common.errors import ReportedError
from common.log import set_up_logging
from common.policy.weights import load_policy
from common.process import DONE
from common.render.film import check_tools
from common.render.rally_recorder import RecordedRally, record
from services.evaluator import once
from services.evaluator.breakdown import breakdown, table
from services.evaluator.filming import film
from services.evaluator.match import play_match
from services.evaluator.measures import Played, measures
from services.evaluator.play import policy_folder
from services.evaluator.real2sim.config import Real2SimConfig
from services.evaluator.real2sim.recorded import Recorded, evenly, read

log = logging.getLogger(__name__)

PROG: Final = "python -m services.evaluator real2sim"
FILM_NAME: Final = "rallies.mp4"


def main(argv: Sequence[str], stop: Event) -> int:
    """Play, measure, print, and write what was asked for; return the exit status."""

    def breathe() -> None:
        once.check(stop)

    config = load(Real2SimConfig, argv, prog=PROG, section="real2sim")
    set_up_logging(config.log_level, "evaluator")
    if not config.data:
        raise ConfigError(f"no recordings to play; name some: {PROG} --data FILE_OR_FOLDER")
    started = time.monotonic()
    video = video_of(config)
    page = _page() if config.out else None  # what is missing is said before anything is played
    if video is not None:
        check_tools()
    folder = policy_folder(config.policy)
    policy = load_policy(folder)
    env = once.task_of(policy.contract, EnvConfig(perception=config.perception), config.noise, rounds=1)

    recorded = read(config, env.flight, breathe)
    block = recorded.rallies.block()
    log.info("playing rallies=%d of=%d mode=%s", len(block.seeds), len(recorded.tracks), config.mode)
    played = play_match(policy, block, env, config.envs, breathe)
    found = measured(recorded, played, config) | {"policy": str(folder)}

    shown = evenly(len(block.seeds), config.shown) if config.out and config.shown else evenly(0, 0)
    filmed = evenly(len(block.seeds), config.film_rallies) if video is not None else evenly(0, 0)
    rows = sorted({*shown.tolist(), *filmed.tolist()})
    again: dict[int, RecordedRally] = {}
    if rows:  # from home, each by itself: a match keeps no flights
        again = dict(zip(rows, record(policy.act, block.of(np.array(rows)), env), strict=True))
    if video is not None:
        found["video"] = str(video)
        note = f"recorded balls, noise {config.noise}, perception {config.perception}"
        film(video, [again[k] for k in filmed.tolist()], config, note, breathe)
    found["seconds"] = round(time.monotonic() - started, 2)
    if page is not None:
        found["report"] = str(Path(config.out) / "report.md")
        page.write(found, played, recorded, {k: again[k] for k in shown.tolist()}, Path(config.out))
    print_found(found, config.json_line)
    return DONE


def video_of(config: Real2SimConfig) -> Path | None:
    """Return the film to write, if one is wanted."""
    if not config.film_rallies or not (config.video or config.out):
        return None
    return Path(config.video) if config.video else Path(config.out) / FILM_NAME


def measured(recorded: Recorded, played: Played, config: Real2SimConfig) -> dict[str, Any]:
    """Return what was played and the measures of it, ready for JSON."""
    valid = recorded.rallies.valid
    by = breakdown(played)
    return (
        {
            "data": config.data,
            "recordings": len(valid),
            "dropped": dict(recorded.dropped),
            "valid_share": round(float(valid.mean()), 4),
        }
        | recorded.fits()
        | measures(played)
        | {
            "by_speed": by["speed"],
            "by_spin": by["spin"],
            "by_spin_kind": by["spin_kind"],
            "mode": config.mode,
            "perception": config.perception,
            "noise": config.noise,
            "seed": config.seed,
        }
    )


def print_found(found: dict[str, Any], as_json: bool) -> None:
    """Print measures for a person, or as one JSON line."""
    if as_json:
        sys.stdout.write(json.dumps(found) + "\n")
        return
    by = {name: found[f"by_{name}"] for name in ("speed", "spin", "spin_kind")}
    for name, value in found.items():
        if not name.startswith("by_"):
            sys.stdout.write(f"{name:>24}  {value}\n")
    sys.stdout.write("\n".join(table(by)) + "\n")


def _page() -> ModuleType:
    """Return what writes the report; raises ReportedError where its libraries aren't installed."""
    try:
        from services.evaluator.real2sim import page  # noqa: PLC0415 - an extra: measuring goes without
    except ModuleNotFoundError as error:
        raise ReportedError(f"a report needs {error.name}: pip install -e '.[report]'") from None
    return page
