"""Settings that all benchmarks have, and how a benchmark is started."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from threading import Event
from typing import Final, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from common.service.config import load
from common.service.process import run_service

SECTION: Final = "bench"


class BenchmarkConfig(BaseModel):
    """Settings of a benchmark."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    json_line: bool = Field(False, alias="json", description="print one JSON object as the last line")


class TimedConfig(BenchmarkConfig):
    """Settings of a benchmark that measures for a while."""

    seconds: float = Field(
        10.0, gt=0, description="duration of the measurement", json_schema_extra={"unit": "s"}
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of all random numbers")


def print_figures(figures: Mapping[str, object], as_json: bool) -> None:
    """Print figures by name for a person, on stderr, and as one JSON line if it is asked for."""
    width = max(map(len, figures))
    for name, value in figures.items():
        print(f"{name:>{width}} {value}", file=sys.stderr)
    if as_json:
        print(json.dumps(figures))


def as_flags(values: Mapping[str, object]) -> list[str]:
    """Return settings by name as flags of a command: --NAME VALUE."""
    return [text for name, value in values.items() for text in (f"--{name}", str(value))]


_Config = TypeVar("_Config", bound=BenchmarkConfig)


def run(
    name: str,
    model: type[_Config],
    main: Callable[[_Config, Event], int],
    argv: Sequence[str] | None = None,
) -> int:
    """Return the exit status of a benchmark that is started from the command line.

    Args:
        name: Of its file.
        model: Its settings; the docstring says what it measures.
        main: Measures and prints. It gets the settings, and the event that Ctrl-C sets.
        argv: Flags; those of the command line by default.
    """
    prog = f"python -m benchmarks.{name}"
    flags = sys.argv[1:] if argv is None else argv
    return run_service(prog, lambda stop: main(load(model, flags, prog=prog, section=SECTION), stop))
