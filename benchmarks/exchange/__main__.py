"""`python -m benchmarks.exchange`: search, and print what was visited."""

import sys
from threading import Event

from pydantic import Field

from benchmarks.exchange.invariants import INVARIANTS
from benchmarks.exchange.model import Bounds
from benchmarks.exchange.search import explore
from benchmarks.settings import BenchmarkConfig, print_figures, run
from common.errors import ReportedError
from common.service.process import DONE


class ExchangeConfig(BenchmarkConfig):
    """Visit every state of the exchange of rollouts, credits, generations and stages within bounds."""

    rollouts: int = Field(2, ge=1, le=8, description="that each of two actors plays")
    losses: int = Field(1, ge=0, le=4, description="messages that are lost or late, on one path")
    repeats: int = Field(1, ge=0, le=4, description="messages that arrive twice, on one path")
    deaths: int = Field(1, ge=0, le=4, description="deaths of the learner, on one path")
    states: int = Field(200_000, ge=1, description="states that are visited at most")


def main(config: ExchangeConfig, stop: Event) -> int:
    """Search and print; a broken invariant ends with its shortest path."""
    bounds = Bounds(config.rollouts, config.losses, config.repeats, config.deaths)
    found = explore(bounds, config.states, stop)
    print_figures(
        {
            "states": found.states,
            "steps": found.steps,
            "ends": found.ends,
            "depth": found.depth,
            "whole": found.is_whole,
            "invariants": len(INVARIANTS) + 1,
            "broken": len(found.broken),
            "steps_by_kind": dict(found.kinds),
        },
        config.json_line,
    )
    if found.broken:
        invariant, path = min(found.broken, key=lambda one: len(one[1]))
        raise ReportedError(f"not true: {invariant}; shortest path: {', '.join(path)}")
    return DONE


if __name__ == "__main__":
    sys.exit(run("exchange", ExchangeConfig, main))
