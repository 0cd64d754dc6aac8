"""How many frames a training needs to the goal, by the size of its datasets.

    F(D) = E_min (1 + D / D_noise)

McCandlish et al. 2018, "An Empirical Model of Large-Batch Training": the trade-off of steps S and examples E,
(S / S_min - 1) (E / E_min - 1) = 1, with datasets for batches, S = E / D. With small datasets E_min frames are enough.
Far above D_noise twice the dataset needs twice the frames, so that more cores save no time. E_min and D_noise are
fitted to measured trainings.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from benchmarks.scaling.costs import first_fault
from common.errors import ReportedError

FILE: Final = Path(__file__).parents[1] / "results" / "large_batches.json"
BEYOND: Final = 1000.0  # D_noise is sought so many times below and above the measured datasets
GRID: Final = (
    400  # values of D_noise in each of three rounds; each round looks between two neighbours of the last
)


class Point(BaseModel):
    """One training."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: int = Field(gt=0, description="frames of a dataset")
    minibatch: int = Field(gt=0, description="frames of a minibatch")
    frames: int | None = Field(gt=0, description="frames to the goal; null: it was not reached")
    limit: int = Field(gt=0, description="frames after which it would have missed the goal")
    seed: int = Field(ge=0)
    more: str = Field("", description="flags of its training besides those of the dataset's size")


class LargeBatches(BaseModel):
    """Measured trainings to the goal: the file ``large_batches.json``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    return_rate: float = Field(ge=0, le=1, description="goal: share of the balls that are returned, at least")
    target_error: float = Field(gt=0, description="goal: mean distance to the target, at most [m]")
    points: tuple[Point, ...] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class FramesToGoal:
    """The fitted law."""

    least: float  # E_min, frames
    noise: float  # D_noise, frames of a dataset
    spread: float  # standard deviation of ln(frames) around the law
    smallest: int  # measured datasets, frames
    largest: int
    reached: int  # trainings that count
    missed: int  # trainings that did not reach the goal, and do not count: the law is too good by them

    def frames(self, dataset: float) -> float:
        """Return the frames to the goal with datasets of so many frames."""
        return self.least * (1.0 + dataset / self.noise)

    def is_extrapolated(self, dataset: float) -> bool:
        """Return whether no training had a dataset as small, or as large."""
        return not self.smallest <= dataset <= self.largest


def read(file: Path) -> LargeBatches | None:
    """Return the measured trainings of a file, or None if there is no file.

    Raises:
        ReportedError: It is no such file.
    """
    if not file.exists():
        return None
    try:
        return LargeBatches.model_validate_json(file.read_bytes())
    except (OSError, ValidationError) as error:
        fault = first_fault(error) if isinstance(error, ValidationError) else error.strerror
        raise ReportedError(
            f"{file}: {fault}; allowed: "
            '{"return_rate": 0.81, "target_error": 0.31, "points": [{"dataset": 8192, "minibatch": 2048, '
            '"frames": 9000000, "limit": 60000000, "seed": 0}]}'
        ) from None


def fit(points: Sequence[Point]) -> FramesToGoal:
    """Return the law with the least squares of ln(frames).

    For a given D_noise the best E_min is a geometric mean. D_noise is sought on a grid that is refined twice.

    Raises:
        ReportedError: Fewer than two sizes of datasets have a training that reached the goal.
    """
    reached = [(point.dataset, point.frames) for point in points if point.frames is not None]
    sizes = sorted({dataset for dataset, _ in reached})
    if len(sizes) < 2:
        raise ReportedError(
            f"trainings that reached the goal have {len(sizes)} sizes of datasets; allowed: two or more"
        )
    datasets, frames = (np.array(column, np.float64) for column in zip(*reached, strict=True))
    low, high = math.log(sizes[0] / BEYOND), math.log(sizes[-1] * BEYOND)
    for _ in range(3):
        grid = np.linspace(low, high, GRID)
        best = int(np.argmin([_residuals(datasets, frames, value).std() for value in grid]))
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, GRID - 1)]
    noise = float(np.exp(grid[best]))
    residuals = _residuals(datasets, frames, grid[best])
    return FramesToGoal(
        least=float(np.exp(residuals.mean())),
        noise=noise,
        spread=float(residuals.std(ddof=min(2, len(residuals) - 1))),
        smallest=sizes[0],
        largest=sizes[-1],
        reached=len(reached),
        missed=len(points) - len(reached),
    )


def _residuals(
    datasets: npt.NDArray[np.float64], frames: npt.NDArray[np.float64], log_noise: float
) -> npt.NDArray[np.float64]:
    """Return ln(frames) - ln(1 + D / D_noise); its mean is ln(E_min)."""
    residuals: npt.NDArray[np.float64] = np.log(frames) - np.log1p(datasets / np.exp(log_noise))
    return residuals
