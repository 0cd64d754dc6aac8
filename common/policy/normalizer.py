"""Running mean and variance, merged exactly, and the frozen copy that normalises."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.jit import kernel

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

CLIP = 5.0  # normalised values are clipped to +-5 (rl_games, and the paper's weights)
EPSILON = 1e-5  # added to the variance
SMALLEST_VARIANCE = 0.01  # a flag that is almost always 0 must not reach the clip when it is 1


@dataclass(frozen=True, slots=True)
class Moments:
    """Mean and variance of all data so far."""

    mean: Array  # (D,) or (): a value's moments are scalars
    var: Array  # (D,) population variance
    count: int

    @staticmethod
    def initial(size: int) -> "Moments":
        """Return mean 0 and variance 1 with the weight of a single sample, so that data soon dominate."""
        return Moments(np.zeros(size), np.ones(size), 1)

    @staticmethod
    def of(data: npt.ArrayLike) -> "Moments":
        """Return the moments of ``data`` (N, D)."""
        values = np.asarray(data)
        if values.ndim == 2 and values.dtype == np.float32:  # a learner's observations: ten times as fast
            mean, var = np.empty((2, values.shape[1]))
            _moments(np.ascontiguousarray(values), mean, var)
            return Moments(mean, var, len(values))
        values = values.astype(np.float64)
        return Moments(values.mean(axis=0), values.var(axis=0), len(values))

    def merged(self, other: "Moments") -> "Moments":
        """Return the moments of both data sets together (Chan, Golub, LeVeque 1983, eq. 1.5)."""
        count = self.count + other.count
        delta = other.mean - self.mean
        mean = self.mean + delta * (other.count / count)
        squares = self.var * self.count + other.var * other.count
        squares = squares + delta * delta * (self.count * (other.count / count))
        return Moments(mean, squares / count, count)

    def first(self, size: int) -> "Moments":
        """Return the moments of the first ``size`` numbers."""
        return Moments(self.mean[:size], self.var[:size], self.count)

    def followed_by(self, longer: "Moments") -> "Moments":
        """Return these moments, and those of ``longer`` for the numbers after them."""
        size = len(self.mean)
        return Moments(
            np.concatenate([self.mean, longer.mean[size:]]),
            np.concatenate([self.var, longer.var[size:]]),
            self.count,
        )

    def recounted(self) -> "Moments":
        """Return the same mean and variance with count 1: what a stage change does (the paper's algorithm 1)."""
        return Moments(self.mean, self.var, 1)


@kernel
def _moments(data: Any, mean: Any, var: Any) -> None:
    """Write mean and population variance (D,) of ``data`` (N, D), with sums in float64 over one row after the other."""
    count, width = data.shape
    mean[:], var[:] = 0.0, 0.0
    for i in range(count):
        for j in range(width):
            mean[j] += data[i, j]
    mean /= count
    for i in range(count):
        for j in range(width):
            difference = data[i, j] - mean[j]
            var[j] += difference * difference
    var /= count


def scale_of(moments: Moments) -> Array:
    """Return what deviations from the mean are divided by (D,): sqrt(var + 1e-5), with a floor of 0.1."""
    scale: Array = np.sqrt(np.maximum(moments.var, SMALLEST_VARIANCE) + EPSILON)
    return scale


def normalize(data: Floats, moments: Moments) -> Floats:
    """Return (data - mean) / scale_of(moments), clipped to +-5, float32, for ``data`` (..., D)."""
    scale = (1.0 / scale_of(moments)).astype(np.float32)
    result = (data - moments.mean.astype(np.float32)) * scale
    return np.clip(result, -CLIP, CLIP, out=result)
