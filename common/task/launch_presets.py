"""The launch presets as one literal table. ``randomization.PROFILES`` has the ranges of the air."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

PresetName = Literal["paper", "strong", "mixed", "match"]

# Distribution of one quantity: its quantiles at LEVELS, with straight lines between them. Nothing beyond the ends is
# drawn.
Curve = tuple[float, float, float, float, float, float, float]
LEVELS: Final[Curve] = (0.01, 0.05, 0.25, 0.50, 0.75, 0.95, 0.99)


def flat(low: float, high: float) -> Curve:
    """Return the curve of a uniform distribution: a straight line."""
    a, b, c, d, e, f, g = (
        low + (high - low) * (level - LEVELS[0]) / (LEVELS[-1] - LEVELS[0]) for level in LEVELS
    )
    return a, b, c, d, e, f, g


class Preset(NamedTuple):
    """How launches of one kind are drawn, in the world frame."""

    position: tuple[Curve, Curve, Curve]  # [m] x, y, z
    # polar: speed [m/s], elevation [rad], azimuth [rad] from -x towards y; not polar: v_x, v_y, v_z [m/s]
    velocity: tuple[Curve, Curve, Curve]
    polar: bool
    # [rad/s] topspin, sidespin (about z), corkscrew (about the horizontal direction of flight); polar presets only
    spin: tuple[Curve, Curve, Curve]
    # [rad/s] the spin is uniform in a ball of one of these radii, each for half of the launches; not for polar presets
    spin_radii: tuple[float, float]
    topspin_by_speed: float  # [-] correlation of the normal scores of topspin and speed; polar presets only


_UNUSED: Final = (flat(0.0, 0.0),) * 3
_PAPER_POSITION: Final = (flat(0.025, 1.35), flat(-0.74, 0.74), flat(0.02, 0.84))
_PAPER_VELOCITY: Final = (flat(-8.0, -3.0), flat(-4.0, 4.0), flat(-1.0, 1.0))

PRESETS: Final[Mapping[str, Preset]] = MappingProxyType(
    {
        # the ranges of the authors' 2023 code, widened to 8 m/s (theirs: to 5 m/s) and given spin (theirs: none)
        "paper": Preset(_PAPER_POSITION, _PAPER_VELOCITY, False, _UNUSED, (100.0, 100.0), 0.0),
        "strong": Preset(_PAPER_POSITION, _PAPER_VELOCITY, False, _UNUSED, (300.0, 300.0), 0.0),
        # half of the launches as paper, half as strong: for training
        "mixed": Preset(_PAPER_POSITION, _PAPER_VELOCITY, False, _UNUSED, (100.0, 300.0), 0.0),
        # quantiles at LEVELS of 609 human strokes in elite and professional matches that landed on the robot's side
        # (recordings of Conti et al. 2026)
        "match": Preset(
            position=(
                # the last quantile is cut from 3.43 to 2.80
                (0.45, 0.98, 1.32, 1.59, 1.97, 2.62, 2.80),
                (-0.79, -0.64, -0.29, -0.04, 0.31, 0.65, 0.83),
                (-0.09, 0.07, 0.17, 0.21, 0.26, 0.34, 0.47),
            ),
            velocity=(
                (4.0, 5.2, 6.5, 10.2, 14.9, 19.5, 22.5),
                (-0.070, 0.0, 0.087, 0.148, 0.227, 0.384, 0.524),
                (-0.576, -0.401, -0.140, 0.035, 0.192, 0.367, 0.436),
            ),
            polar=True,
            spin=(
                (-325.0, -269.0, -105.0, 288.0, 481.0, 750.0, 820.0),
                (-198.0, -122.0, -31.0, 25.0, 92.0, 220.0, 337.0),
                (-133.0, -85.0, -25.0, 1.0, 26.0, 91.0, 176.0),
            ),
            spin_radii=(0.0, 0.0),
            topspin_by_speed=0.75,
        ),
    }
)
