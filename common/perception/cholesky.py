"""Small symmetric positive definite systems for kernels. numba's own linear algebra needs SciPy (ADR-0003)."""

import math

import numpy as np
import numpy.typing as npt

from common.jit import kernel

Array = npt.NDArray[np.float64]


@kernel
def inverse_2(xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return xx, xy and yy of the inverse of a symmetric 2 x 2 matrix."""
    det = xx * yy - xy * xy
    return yy / det, -xy / det, xx / det


@kernel
def factor(matrix: Array, lower: Array) -> None:
    """Write L with L L' = ``matrix`` (n, n); nan where it isn't positive. Only its lower triangle is read."""
    for i in range(matrix.shape[0]):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = math.sqrt(rest) if rest > 0.0 else math.nan
            else:
                lower[i, j] = rest / lower[j, j]


@kernel
def substitute(lower: Array, right: Array, out: Array) -> None:
    """Write x with L L' x = ``right`` (n,) into ``out``, which may be the same array as ``right``."""
    n = right.shape[0]
    for i in range(n):
        rest = right[i]
        for k in range(i):
            rest -= lower[i, k] * out[k]
        out[i] = rest / lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            out[i] -= lower[k, i] * out[k]
        out[i] /= lower[i, i]


@kernel
def inverse(lower: Array, out: Array) -> None:
    """Write (L L')^-1 (n, n) into ``out``."""
    n = lower.shape[0]
    column = np.empty(n)
    for j in range(n):
        column[:] = 0.0
        column[j] = 1.0
        substitute(lower, column, column)
        for i in range(n):
            out[i, j] = column[i]
