"""Measuring a policy once, from a folder: what the evaluator does with --policy, and `play` before it films."""

import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from threading import Event
from typing import Any, Final, Protocol

from common.env.rally_env import EnvConfig
from common.errors import ReportedError
from common.policy.weights import Contract, Policy
from services.evaluator.breakdown import breakdown, survival, table
from services.evaluator.match import TRAINING_ONLY, environments, evaluation_rallies, play_match
from services.evaluator.measures import measures


class StoppedError(ReportedError):
    """Somebody asked the command to stop before it was done."""


class MatchSettings(Protocol):
    """Which rallies are played, and how many together; the evaluator's settings and those of `play` are such."""

    @property
    def rallies(self) -> int: ...  # noqa: D102
    @property
    def launch(self) -> str: ...  # noqa: D102
    @property
    def noise(self) -> str: ...  # noqa: D102
    @property
    def rounds(self) -> int: ...  # noqa: D102
    @property
    def seed(self) -> int: ...  # noqa: D102
    @property
    def envs(self) -> int: ...  # noqa: D102


def check(stop: Event) -> None:
    """Raise StoppedError if a stop was asked for."""
    if stop.is_set():
        raise StoppedError("stopped before it was done")


SET_BY: Final = "the policy's contract or the match"  # ... sets what `given_elsewhere` finds
OF_CONTRACT: Final[Mapping[str, Callable[[Contract, EnvConfig], Any]]] = {
    "control_rate_hz": lambda contract, _: contract.control_rate_hz,
    "robot": lambda contract, _: contract.robot,
    "observation": lambda contract, _: contract.observation_options,
    "flight": lambda contract, env: contract.env.get(
        "flight", env.flight
    ),  # the oldest contracts don't say it
}
"""Settings of the task that are a policy's own, whatever is asked for."""
_INSTEAD: Final = {
    "env.noise": "noise",
    "env.rounds": "rounds",
    "env.observation.spin_expected": "spin_expected",
}


def given_elsewhere(paths: Iterable[str]) -> dict[str, str]:
    """Return those dotted paths of a command that measures a policy which set nothing, and what to give instead.

    "": nothing, the contract has it, or no match has it, being for training alone.
    """
    owned = {"network", *(f"env.{name}" for name in (*OF_CONTRACT, *TRAINING_ONLY, "reward"))}
    known, found = set(paths), {}
    for path in known:
        if path in _INSTEAD or path in owned or path.startswith(tuple(f"{name}." for name in owned)):
            instead = _INSTEAD.get(path, "")
            found[path] = instead if instead in known else ""
    return found


def task_of(contract: Contract, env: EnvConfig, noise: str, rounds: int) -> EnvConfig:
    """Return the task for a policy: robot, control rate, observation and the ball's flight are its contract's."""
    own = {name: of(contract, env) for name, of in OF_CONTRACT.items()}
    return env.model_copy(update={"noise": noise, "rounds": rounds, **own})


def measure(
    policy: Policy, folder: Path, env: EnvConfig, config: MatchSettings, breathe: Callable[[], None]
) -> dict[str, Any]:
    """Return the measures of a policy over fixed rallies, what was played, and rates by kind of ball (``by``)."""
    started = time.monotonic()
    rallies = evaluation_rallies(config.rallies, config.launch, config.noise, config.seed, env.flight)
    played = play_match(policy, rallies, env, config.envs, breathe)
    about = {
        "launch": config.launch,
        "noise": config.noise,
        "rounds": config.rounds,
        "envs": environments(config.rallies, config.envs, config.rounds),
        "seed": config.seed,
        "collision": env.collision,
        "perception": env.perception,
        "spin_expected": env.observation.spin_expected,
        "policy": str(folder),
        "seconds": round(time.monotonic() - started, 2),
    }
    return measures(played) | survival(played) | about | {"by": breakdown(played)}


def print_measures(found: dict[str, Any], as_json: bool) -> None:
    """Print measures for a person, or as one JSON line."""
    if as_json:
        sys.stdout.write(json.dumps(found) + "\n")
        return
    for name, value in found.items():
        if name != "by":
            sys.stdout.write(f"{name:>24}  {value}\n")
    sys.stdout.write("\n".join(table(found["by"])) + "\n")
