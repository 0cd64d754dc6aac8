"""Golden outcomes: whether the policies of the box play fixed rallies as they did when the outcomes were recorded.

    python -m benchmarks.golden --json
    python -m benchmarks.golden --write true    after a change of the task or the box, to record them again

The file ``results/golden_outcomes.npz`` holds the results of 8,800 rallies in eleven cases. This benchmark plays them
again and counts the rallies with any difference. A change that claims to leave behaviour alone must have none.
Bits are only comparable on the same processor and with the same library versions: elsewhere a difference is no error.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from benchmarks.settings import BenchmarkConfig, run
from common.errors import ConfigError
from common.evaluation.config import MatchConfig
from common.evaluation.evaluate import check
from common.evaluation.match import evaluation_rallies, match_task, play_match
from common.evaluation.measures import MatchResult
from common.policy.box import policy_folder
from common.policy.folder import load_policy

FILE: Final = Path(__file__).parent / "results" / "golden_outcomes.npz"
SEED: Final = 20260
FIELDS: Final = (
    *("seeds", "outcomes", "landings", "landing_errors"),
    *("caught", "over", "returns", "rounds"),
)

Golden = Mapping[str, npt.NDArray[Any]]


class Case(NamedTuple):
    """A match whose results are in the file."""

    policy: str  # of the box
    rallies: int
    launch: str
    randomization: str
    rounds: int = 1
    perception: str = "cheap"
    collision: str = "tailored"
    expected_spin: str = "contract"


CASES: Final[Mapping[str, Case]] = {
    "default_paper": Case("default", 2000, "paper", "standard"),
    "paper_paper": Case("paper", 2000, "paper", "standard"),
    "default_strong": Case("default", 1000, "strong", "standard"),
    "default_five_rounds": Case("default", 1000, "paper", "standard", rounds=5),
    "default_match_hard": Case("default", 500, "match", "hard"),
    "default_camera": Case("default", 500, "paper", "standard", perception="full"),
    "default_mujoco_contacts": Case("default", 200, "paper", "standard", collision="original"),
    "default_learnt": Case("default", 500, "strong", "standard", expected_spin="learnt"),
    "default_mixed": Case("default", 500, "mixed", "standard", expected_spin="mixed"),
    "paper_off": Case("paper", 300, "paper", "off"),
    "paper_camera_hard": Case("paper", 300, "strong", "hard", perception="full"),
}


def load_golden() -> Golden:
    """Return the file's arrays by "case/field"."""
    with np.load(FILE) as file:
        return {name: file[name] for name in file.files}


def play(case: Case, rallies: int, on_tick: Callable[[], None] = lambda: None) -> MatchResult:
    """Return the result of the first ``rallies`` rallies of a case."""
    settings = case._asdict() | {"rallies": rallies, "seed": SEED}
    policy = load_policy(policy_folder(settings.pop("policy")))
    match = MatchConfig.model_validate(settings)
    task = match_task(policy.contract, match, match.expected_spin)
    return play_match(policy, evaluation_rallies(rallies, task, SEED), task, on_tick=on_tick)


def differences(name: str, result: MatchResult, golden: Golden) -> int:
    """Return how many rallies of a case differ in any field from the file. NaN equals NaN."""
    expected = {field: golden[f"{name}/{field}"] for field in FIELDS}
    if len(result.seeds) != len(expected["seeds"]):
        return max(len(result.seeds), len(expected["seeds"]))
    differs = np.zeros(len(result.seeds), np.bool_)
    for field, old in expected.items():
        new = getattr(result, field)
        same = (new == old) | ((new != new) & (old != old))  # noqa: PLR0124 - NaN differs from itself
        differs |= ~same.reshape(len(same), -1).all(axis=1)
    return int(differs.sum())


class GoldenConfig(BenchmarkConfig):
    """Play rallies whose results were recorded, and count the rallies that differ.

    Bits are only comparable on the same processor and with the same library versions. The exit status is 1 if any
    rally differs.
    """

    cases: tuple[str, ...] = Field((), description=f"cases to play; empty: all of {', '.join(CASES)}")
    write: bool = Field(False, description="record the outcomes of all cases instead of comparing them")

    @model_validator(mode="after")
    def _all_are_written(self) -> Self:
        if self.write and self.cases:
            raise ValueError(f"write with cases {', '.join(self.cases)}; allowed: write alone, for all cases")
        return self


def write(stop: Event) -> int:
    """Record the outcomes of all cases."""
    played = {name: play(case, case.rallies, lambda: check(stop)) for name, case in CASES.items()}
    arrays = {
        f"{name}/{field}": getattr(result, field) for name, result in played.items() for field in FIELDS
    }
    np.savez_compressed(FILE, allow_pickle=False, **arrays)
    print(f"{sum(case.rallies for case in CASES.values())} rallies recorded in {FILE.name}")
    return 0


def main(config: GoldenConfig, stop: Event) -> int:
    """Play, compare and print."""
    if config.write:
        return write(stop)
    started, golden = time.monotonic(), load_golden()
    if unknown := set(config.cases) - CASES.keys():
        raise ConfigError(f"unknown cases {sorted(unknown)}; allowed: {', '.join(CASES)}")
    by_case: dict[str, dict[str, int]] = {}
    for name in config.cases or CASES:
        result = play(CASES[name], CASES[name].rallies, lambda: check(stop))
        by_case[name] = {
            "rallies": CASES[name].rallies,
            "differences": differences(name, result, golden),
        }
        print(f"{name:>24} {by_case[name]}", file=sys.stderr, flush=True)
    total: dict[str, Any] = {
        key: sum(case[key] for case in by_case.values()) for key in ("rallies", "differences")
    }
    if config.json_line:
        print(json.dumps(total | {"cases": by_case, "seconds": round(time.monotonic() - started, 1)}))
    else:
        print(f"{total['rallies']} rallies compared, {total['differences']} differ")
    return 1 if total["differences"] else 0


if __name__ == "__main__":
    sys.exit(run("golden", GoldenConfig, main))
