"""A run's past, for the panel: the return rate as a sparkline, and when its stages began."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

STAGES: Final = {1: "1 catch", 2: "2 hit", 3: "3 aim"}
BARS: Final = "▁▂▃▄▅▆▇█"


@dataclass(frozen=True, slots=True)
class Point:
    """Training at one epoch."""

    frames: float
    stage: int
    return_rate: float  # with exploration noise, 0..1; nan: no rally ended


def points_of(rows: Iterable[Mapping[str, str]]) -> list[Point]:
    """Return the points of a run's metrics.csv; none where it has other columns."""
    return [
        Point(float(row["frames"]), int(float(row["stage"])), float(row["return_rate"] or "nan"))
        for row in rows
        if all(row.get(name) for name in ("frames", "stage")) and "return_rate" in row
    ]


def stage_starts(points: Sequence[Point]) -> list[tuple[int, float]]:
    """Return each stage that was reached, with the frames at which it began."""
    starts: list[tuple[int, float]] = []
    for before, point in zip([None, *points], points, strict=False):
        if before is None or before.stage != point.stage:
            starts.append((point.stage, before.frames if before else 0.0))
    return starts


def sparkline(points: Sequence[Point], width: int) -> str:
    """Return the mean return rates of ``width`` equal parts of the frames so far as bars from 0 to 100 %.

    A part in which no rally ended continues the one before it. "" without any rate.
    """
    known = [point for point in points if not math.isnan(point.return_rate)]
    if not known:
        return ""
    sums, counts = [0.0] * width, [0] * width
    for point in known:
        part = max(math.ceil(width * point.frames / points[-1].frames) - 1, 0)
        sums[part] += point.return_rate
        counts[part] += 1
    line, bar = "", " "
    for total, count in zip(sums, counts, strict=True):
        if count:
            bar = BARS[round(min(max(total / count, 0.0), 1.0) * (len(BARS) - 1))]
        line += bar
    return line
