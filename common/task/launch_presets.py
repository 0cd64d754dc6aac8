"""The kinds of ball and the launch presets as literal tables. ``randomization.PROFILES`` has the ranges of the air."""

import math
from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.task.config import PresetName

Array = npt.NDArray[np.float64]

# Distribution of one quantity: its quantiles at LEVELS, with straight lines between them. Nothing beyond the ends is
# drawn.
Curve = tuple[float, float, float, float, float, float, float]
LEVELS: Final[Curve] = (0.01, 0.05, 0.25, 0.50, 0.75, 0.95, 0.99)


class Kind(IntEnum):
    """Kind of a ball: the last column of a launch."""

    PAPER = 0
    STRONG = 1
    MATCH = 2
    ELITE = 3
    SERVE = 4  # it bounces on the server's own court first
    RECORDED = 5  # a recorded ball that is no serve


SERVE: Final = int(Kind.SERVE)  # kernels compare plain integers


def flat(low: float, high: float) -> Curve:
    """Return the curve of a uniform distribution: a straight line."""
    a, b, c, d, e, f, g = (
        low + (high - low) * (level - LEVELS[0]) / (LEVELS[-1] - LEVELS[0]) for level in LEVELS
    )
    return a, b, c, d, e, f, g


# The quantities of a stroke, in the order of the correlations
QUANTITIES: Final = ("x", "y", "z", "speed", "elevation", "azimuth", "topspin", "sidespin", "corkscrew")
Correlations = Mapping[tuple[str, str], float]


def score_factor(ranks: Correlations) -> Array:
    """Return the Cholesky factor (9, 9) of the normal scores' correlations, for these rank correlations.

    A normal copula: quantities with Spearman's correlation r have normal scores with the correlation 2 sin(pi r / 6)
    (Pearson 1907). Pairs that are not named have 0.

    Raises:
        ValueError: No joint distribution has these correlations.
    """
    matrix = np.eye(len(QUANTITIES))
    for (one, other), rank in ranks.items():
        i, j = QUANTITIES.index(one), QUANTITIES.index(other)
        matrix[i, j] = matrix[j, i] = 2.0 * math.sin(math.pi * rank / 6.0)
    try:
        factor = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(f"rank correlations {dict(ranks)} fit no joint distribution") from None
    return factor.astype(np.float64)


class Balls(NamedTuple):
    """How balls of one kind are drawn, in the world frame."""

    position: tuple[Curve, Curve, Curve]  # [m] x, y, z
    # stroke: speed [m/s], elevation [rad], azimuth [rad] from -x towards y; otherwise v_x, v_y, v_z [m/s]
    velocity: tuple[Curve, Curve, Curve]
    # [rad/s] of a stroke: topspin, sidespin (about z), corkscrew (about the horizontal direction of flight)
    spin: tuple[Curve, Curve, Curve]
    factor: Array  # of a stroke: ``score_factor``
    spin_radius: float = (
        0.0  # [rad/s] otherwise the spin is uniform in a ball of this radius; 0: it is a stroke
    )
    speed_range: tuple[float, float] = (0.0, math.inf)  # [m/s] a faster or slower stroke is not of this kind
    least_spin: float = 0.0  # [rad/s] a stroke with less spin is not of this kind


_UNUSED: Final = (flat(0.0, 0.0),) * 3


def _box(spin_radius: float) -> Balls:
    """Return balls of the ranges of the authors' 2023 code, widened to 8 m/s (theirs: to 5 m/s), with spin."""
    return Balls(
        position=(flat(0.025, 1.35), flat(-0.74, 0.74), flat(0.02, 0.84)),
        velocity=(flat(-8.0, -3.0), flat(-4.0, 4.0), flat(-1.0, 1.0)),
        spin=_UNUSED,
        factor=score_factor({}),
        spin_radius=spin_radius,
    )


# 610 strokes of elite and professional players in matches that landed on the robot's half, at the moment of the stroke
# (match events that Conti et al. 2026 published). Fast balls are topspin, from far behind the table and flat; slow ones
# are pushes with backspin, near the table and steep. Players aim, and a draw does not: of the candidates from these
# numbers a fifth is valid, and the valid ones have the players' quantiles at LEVELS (to 3 % of the range from p5 to
# p95) and rank correlations (to 0.06). To that end these numbers were fitted, half a step at a time
_MATCH: Final = Balls(
    position=(
        (0.325, 0.978, 1.378, 1.641, 2.058, 2.751, 3.500),
        (-0.815, -0.647, -0.280, -0.021, 0.336, 0.676, 0.868),
        (-0.171, 0.046, 0.166, 0.209, 0.261, 0.343, 0.494),
    ),
    velocity=(
        (3.78, 5.25, 7.52, 14.16, 16.68, 20.82, 24.55),
        (-0.082, 0.007, 0.100, 0.161, 0.217, 0.392, 0.568),
        (-0.651, -0.467, -0.165, 0.018, 0.188, 0.371, 0.453),
    ),
    spin=(
        (-334.0, -263.0, -82.0, 346.0, 514.0, 778.0, 833.0),
        (-212.0, -127.0, -32.0, 26.0, 94.0, 227.0, 361.0),
        (-148.0, -90.0, -25.5, 0.8, 27.0, 94.0, 189.0),
    ),
    factor=score_factor(
        {
            ("speed", "x"): 0.341,
            ("speed", "z"): 0.521,
            ("speed", "elevation"): -0.497,
            ("speed", "topspin"): 0.706,
            ("topspin", "x"): 0.391,
            ("topspin", "z"): 0.302,
            ("topspin", "elevation"): -0.231,
            ("z", "elevation"): -0.524,
            ("y", "azimuth"): -0.751,
            ("x", "z"): 0.222,
            ("x", "elevation"): -0.289,
        }
    ),
)

# 1,352 recorded serves of players of all levels (D'Ambrosio et al. 2025): place, speed, direction and correlations are
# theirs. Their spin is slow (95 % below 50 rad/s); these balls have about three times as much
_SERVE: Final = Balls(
    position=(
        (1.12, 1.22, 1.37, 1.44, 1.48, 1.56, 1.64),
        (-0.67, -0.55, -0.28, 0.16, 0.37, 0.58, 0.70),
        (0.11, 0.14, 0.20, 0.26, 0.32, 0.39, 0.42),
    ),
    velocity=(
        (3.8, 4.3, 5.0, 5.5, 6.1, 7.1, 7.9),
        (-0.59, -0.51, -0.415, -0.346, -0.284, -0.19, -0.11),
        (-0.454, -0.347, -0.217, -0.075, 0.092, 0.366, 0.449),
    ),
    spin=(
        (-140.0, -90.0, -26.0, 1.5, 45.0, 105.0, 140.0),
        (-140.0, -97.0, -43.0, -10.0, 16.0, 81.0, 120.0),
        (-140.0, -73.0, -19.0, 2.0, 27.0, 80.0, 150.0),
    ),
    factor=score_factor(
        {
            ("y", "azimuth"): -0.79,
            ("z", "speed"): -0.60,
            ("elevation", "topspin"): 0.33,
            ("elevation", "sidespin"): -0.26,
            ("y", "sidespin"): -0.31,
            ("azimuth", "sidespin"): 0.33,
            ("sidespin", "corkscrew"): -0.47,
        }
    ),
)

KINDS: Final[tuple[Balls, ...]] = (
    _box(100.0),
    _box(300.0),
    _MATCH,
    _MATCH._replace(speed_range=(15.0, 20.0), least_spin=600.0),
    _SERVE,
)
"""How balls are drawn, by ``Kind`` (recorded ones are not drawn)."""

PRESETS: Final[Mapping[PresetName, tuple[float, ...]]] = MappingProxyType(
    {
        #         paper strong match elite serve
        "paper": (1.00, 0.00, 0.00, 0.00, 0.00),
        "strong": (0.00, 1.00, 0.00, 0.00, 0.00),
        "mixed": (0.50, 0.50, 0.00, 0.00, 0.00),
        "match": (0.00, 0.00, 1.00, 0.00, 0.00),
        "elite": (0.00, 0.00, 0.00, 1.00, 0.00),
        "serve": (0.00, 0.00, 0.00, 0.00, 1.00),
        "all": (0.20, 0.20, 0.20, 0.20, 0.20),
    }
)
"""The share of each of KINDS in a preset. An actor plays each kind the more often, the more often it is lost."""
