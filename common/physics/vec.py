"""Vectors as tuples of three floats. They stay in registers, and a kernel reads like its equations."""

import math

import numpy as np
import numpy.typing as npt

from common.jit import kernel

Vec = tuple[float, float, float]


@kernel
def vec_at(row: npt.NDArray[np.float64], at: int) -> Vec:
    """Return the vector in columns ``at``, ``at + 1`` and ``at + 2`` of a row."""
    return (row[at], row[at + 1], row[at + 2])


@kernel
def add(a: Vec, b: Vec) -> Vec:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def sub(a: Vec, b: Vec) -> Vec:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(s: float, a: Vec) -> Vec:
    """Return s a."""
    return (s * a[0], s * a[1], s * a[2])


@kernel
def axpy(s: float, a: Vec, b: Vec) -> Vec:
    """Return s a + b."""
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2])


@kernel
def dot(a: Vec, b: Vec) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vec, b: Vec) -> Vec:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel
def norm(a: Vec) -> float:
    """Return |a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
