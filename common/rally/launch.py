"""Launches: how one is drawn from its seed, and blocks of those that make a valid rally.

A rally is valid if it crosses the net untouched and its first touch of anything is the robot's court.
Everything random about a rally - launch and air, and at use target, table and rubber - is drawn from its own
64-bit seed by counter (``draws.py``): no generator state to keep or to lose. So a block of valid rallies is a
function of its arguments, and any launch can be drawn again from preset, noise profile and seed.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics import touch
from common.physics.flight import SIMPLE
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.vec import Vec, cross
from common.rally.draws import Stream, between, bits, normal_pair, uniform
from common.rally.launch_presets import LEVELS, PRESETS, Curve, Preset
from common.rally.noise import PROFILES, NoiseProfile

Array = npt.NDArray[np.float64]
Seeds = npt.NDArray[np.uint64]

# Layout of a launch row; the seed travels beside it, because a float64 can't hold it
POSITION: Final = slice(0, 3)  # m
VELOCITY: Final = slice(3, 6)  # m/s
SPIN: Final = slice(6, 9)  # rad/s
DRAG_FACTOR: Final = 9  # [-]
LIFT_FACTOR: Final = 10  # [-]
LAUNCH_SIZE: Final = 11

LONGEST_FLIGHT: Final = 2.0  # s; no launch of any preset stays up that long
FEWEST_VALID: Final = 1e-3  # [-] a preset with a smaller yield is a mistake, not a preset


class Purpose(IntEnum):
    """What a rally is for: the two top bits of its seed, so that no purpose can meet another's rallies."""

    TRAINING = 0
    EVALUATION = 1
    FALLBACK = 2  # launches nobody validated, for an empty buffer
    RECORDED = 3  # balls that somebody hit, and a camera saw


@dataclass(frozen=True, slots=True)
class RallyBlock:
    """Rallies as they were drawn.

    Attributes:
        launches: (n, 11) float64: position, velocity, spin, drag factor, lift factor.
        seeds: (n,) uint64: what the rest of each rally is drawn from.
        drawn: How many candidates were drawn for these n.
        paths: (n, m, 7) float64 that the balls keep to until they are hit, as ``play.keep_to_path``; None:
            they fly as physics has it.
    """

    launches: Array
    seeds: Seeds
    drawn: int
    paths: Array | None = None

    @property
    def path_rows(self) -> int:
        """Return how many samples a path has room for; 0: there is none."""
        return 0 if self.paths is None else self.paths.shape[1]

    def of(self, rows: npt.NDArray[np.int64]) -> "RallyBlock":
        """Return these rallies."""
        paths = None if self.paths is None else self.paths[rows]
        return RallyBlock(self.launches[rows], self.seeds[rows], self.drawn, paths)


@kernel
def _quantile(curve: Curve, u: float) -> float:
    """Return the curve's value at ``u`` in [0, 1): the ends beyond LEVELS are cut off."""
    level = LEVELS[0] + (LEVELS[-1] - LEVELS[0]) * u
    k = 1
    while k < len(LEVELS) - 1 and level > LEVELS[k]:
        k += 1
    w = (level - LEVELS[k - 1]) / (LEVELS[k] - LEVELS[k - 1])
    return curve[k - 1] + w * (curve[k] - curve[k - 1])


@kernel
def _drawn(curves: tuple[Curve, Curve, Curve], seed: int, counter: int) -> Vec:
    """Return one independent value of each curve."""
    return (
        _quantile(curves[0], uniform(seed, Stream.LAUNCH, counter)),
        _quantile(curves[1], uniform(seed, Stream.LAUNCH, counter + 1)),
        _quantile(curves[2], uniform(seed, Stream.LAUNCH, counter + 2)),
    )


@kernel
def _share_below(score: float) -> float:
    """Return the standard normal distribution function."""
    return 0.5 * math.erfc(-score / math.sqrt(2.0))


@kernel
def _ball_spin(radius: float, seed: int, counter: int) -> Vec:
    """Return a spin uniform in a ball of ``radius``, never zero [rad/s]."""
    up = between(-1.0, 1.0, seed, Stream.LAUNCH, counter)
    azimuth = between(-math.pi, math.pi, seed, Stream.LAUNCH, counter + 1)
    # 1 - u lies in (0, 1]
    rate = radius * np.cbrt(1.0 - uniform(seed, Stream.LAUNCH, counter + 2))
    across = rate * math.sqrt(1.0 - up * up)
    return (across * math.cos(azimuth), across * math.sin(azimuth), rate * up)


@kernel
def _stroke(preset: Preset, seed: int) -> tuple[Vec, Vec]:
    """Return velocity and spin of a polar preset; speed and topspin have correlated normal scores."""
    score, other = normal_pair(seed, Stream.LAUNCH, 8)
    correlation = preset.topspin_by_speed
    topspin_score = correlation * score + math.sqrt(1.0 - correlation * correlation) * other
    speed = _quantile(preset.velocity[0], _share_below(score))
    topspin = _quantile(preset.spin[0], _share_below(topspin_score))
    _, elevation, azimuth = _drawn(preset.velocity, seed, 3)
    _, sidespin, corkscrew = _drawn(preset.spin, seed, 6)
    heading = (-math.cos(azimuth), math.sin(azimuth), 0.0)
    across = cross((0.0, 0.0, 1.0), heading)
    flat_speed = speed * math.cos(elevation)
    return (
        (flat_speed * heading[0], flat_speed * heading[1], speed * math.sin(elevation)),
        (
            topspin * across[0] + corkscrew * heading[0],
            topspin * across[1] + corkscrew * heading[1],
            sidespin,
        ),
    )


@kernel
def launch(preset: Preset, noise: NoiseProfile, seed: int) -> tuple[Vec, Vec, Vec, float, float]:
    """Return position, velocity, spin, drag and lift factor of the launch with this seed, valid or not."""
    position = _drawn(preset.position, seed, 0)
    if preset.polar:
        velocity, spin = _stroke(preset, seed)
    else:
        velocity = _drawn(preset.velocity, seed, 3)
        mild, strong = preset.spin_radii
        spin = _ball_spin(mild if uniform(seed, Stream.LAUNCH, 11) < 0.5 else strong, seed, 6)
    drag_factor = between(noise.drag_factor[0], noise.drag_factor[1], seed, Stream.LAUNCH, 9)
    lift_factor = between(noise.lift_factor[0], noise.lift_factor[1], seed, Stream.LAUNCH, 10)
    return position, velocity, spin, drag_factor, lift_factor


@kernel
def is_valid(
    position: Vec,
    velocity: Vec,
    spin: Vec,
    drag_factor: float,
    lift_factor: float,
    model: int,
    no_robot: Array,
) -> bool:
    """Return whether the ball starts free, crosses the net untouched and touches the robot's court first."""
    if touch.table_gap(position)[0] <= 0.0 or touch.net_gap(position)[0] <= 0.0:
        return False
    _, _, _, what, _ = fly_to_touch(
        position, velocity, spin, LONGEST_FLIGHT, drag_factor, lift_factor, model, no_robot
    )
    return what == touch.ROBOT_COURT


@kernel
def _fill(
    preset: Preset,
    noise: NoiseProfile,
    seed: int,
    shard: int,
    block: int,
    purpose: int,
    model: int,
    valid_only: bool,
    most: int,
    no_robot: Array,
    launches: Array,
    seeds: Seeds,
) -> tuple[int, int]:
    """Fill the arrays from their beginning; return how many rows are filled, by how many candidates."""
    key = bits(seed, shard, block)
    filled = 0
    drawn = 0
    while filled < len(seeds) and drawn < most:
        seeds[filled] = (bits(key, purpose, drawn) >> np.uint64(2)) | (np.uint64(purpose) << np.uint64(62))
        rally = seeds[filled]
        drawn += 1
        position, velocity, spin, drag_factor, lift_factor = launch(preset, noise, rally)
        if valid_only and not is_valid(position, velocity, spin, drag_factor, lift_factor, model, no_robot):
            continue
        for k in range(3):
            launches[filled, k] = position[k]
            launches[filled, 3 + k] = velocity[k]
            launches[filled, 6 + k] = spin[k]
        launches[filled, DRAG_FACTOR] = drag_factor
        launches[filled, LIFT_FACTOR] = lift_factor
        filled += 1
    return filled, drawn


def draw_rallies(
    n: int,
    *,
    seed: int,
    shard: int = 0,
    block: int = 0,
    preset: str = "paper",
    noise: str = "standard",
    purpose: Purpose = Purpose.TRAINING,
    model: int = SIMPLE,
) -> RallyBlock:
    """Return a block of ``n`` valid rallies: the same arguments give the same bits in every process.

    With ``Purpose.FALLBACK`` nothing is validated: the launches are the preset's as they come.

    Args:
        n: Rallies in the block.
        seed: Of the run, 0 .. 2^64 - 1.
        shard: Which of the run's streams of blocks.
        block: Index in that stream. One seed's blocks share no rally.
        preset: A key of ``PRESETS``.
        noise: A key of ``noise.PROFILES``: how far drag and lift are drawn from nominal. The launches behind
            two profiles are the same up to what the air makes invalid.
        purpose: Rallies of different purposes never share a seed.
        model: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    launches = np.empty((n, LAUNCH_SIZE))
    seeds = np.empty(n, np.uint64)
    most = math.ceil(n / FEWEST_VALID)
    filled, drawn = _fill(
        PRESETS[preset],
        PROFILES[noise],
        # a NumPy scalar: half of all seeds are too big for the int64 that numba makes of a Python int
        np.array([seed], np.uint64)[0],
        shard,
        block,
        int(purpose),
        model,
        purpose != Purpose.FALLBACK,
        most,
        NO_ROBOT,
        launches,
        seeds,
    )
    if filled < n:
        raise ValueError(
            f"launch preset {preset!r}: {filled} valid rallies in {drawn} candidates, wanted {n}"
        )
    return RallyBlock(launches, seeds, drawn)
