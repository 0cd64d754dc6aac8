"""Measuring a policy, for `topspin evaluate` and for other commands that need the measures."""

import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

from common.errors import StoppedError
from common.evaluation.breakdown import breakdown, survival
from common.evaluation.config import MatchConfig
from common.evaluation.match import environments, evaluation_rallies, match_task, play_match
from common.evaluation.measures import measures
from common.evaluation.robot_measures import robot_part
from common.policy.folder import Policy


def check(stop: Event) -> None:
    """Raise StoppedError if a stop was requested."""
    if stop.is_set():
        raise StoppedError("stopped before it was done")


def measure(
    policy: Policy,
    folder: Path,
    config: MatchConfig,
    on_tick: Callable[[], None] = lambda: None,
    on_left: Callable[[int], None] = lambda _left: None,
) -> dict[str, Any]:
    """Return a policy's measures over fixed rallies, the match's conditions, and rates by kind of ball (``by``).

    ``on_tick`` and ``on_left`` are those of ``play_match``.
    """
    started = time.monotonic()
    task = match_task(policy.contract, config, config.expected_spin)
    rallies = evaluation_rallies(config.rallies, task, config.seed)
    result = play_match(policy, rallies, task, config.envs, on_tick, on_left=on_left)
    match = {
        "launch": task.launch,
        "randomization": task.randomization,
        "flight": task.flight,
        "rounds": task.rounds,
        "envs": environments(config.rallies, config.envs, task.rounds),
        "seed": config.seed,
        "collision": task.collision,
        "perception": task.perception,
        "expected_spin": task.observation.expected_spin,
        "end_to_end": policy.contract.is_end_to_end,
        "policy": str(folder),
        "seconds": round(time.monotonic() - started, 2),
    }
    found = measures(result) | survival(result) | match
    return found | robot_part(result.robot, task.robot) | {"by": breakdown(result)}
