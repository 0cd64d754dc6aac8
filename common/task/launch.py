"""Launches: how one is drawn from its seed, and how blocks of valid rallies are drawn.

A rally is valid if the ball crosses the net without a touch and its first touch is the robot's court.

All random numbers of a rally come from its own 64-bit seed (``counter_rng``). Launch and air are drawn here. Target,
table and rubber are drawn when the rally is played. There is no generator state to keep or to lose. So a block of valid
rallies is a function of its arguments, and any launch can be drawn again from preset, randomization and seed.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics import touch
from common.physics.flight import Air
from common.physics.fly import NO_ROBOT, RobotPath, fly_to_touch
from common.physics.vec import Vec, cross
from common.task.coarse_flight import UNSURE, VALID, coarse_verdict
from common.task.config import TaskConfig
from common.task.counter_rng import Stream, between, bits, normal_pair, uniform
from common.task.launch_presets import LEVELS, PRESETS, Curve, Preset
from common.task.randomization import PROFILES, RandomizationProfile

Array = npt.NDArray[np.float64]
Seeds = npt.NDArray[np.uint64]

# Columns of a launch. The seed is a separate array, because a float64 can't hold it
POSITION: Final = slice(0, 3)  # [m]
VELOCITY: Final = slice(3, 6)  # [m/s]
SPIN: Final = slice(6, 9)  # [rad/s]
DRAG_FACTOR: Final = 9  # [-]
LIFT_FACTOR: Final = 10  # [-]
LAUNCH_SIZE: Final = 11

LONGEST_FLIGHT: Final = 2.0  # [s] no launch of any preset stays in the air that long
FEWEST_VALID: Final = 1e-3  # [-] smallest share of valid launches; a preset with fewer is refused


class Purpose(IntEnum):
    """What a rally is for: the two top bits of its seed. So two purposes never share a rally."""

    TRAINING = 0
    EVALUATION = 1
    FALLBACK = 2  # launches that were not validated, for an empty buffer
    RECORDED = 3  # recorded tracks of real balls


@dataclass(frozen=True, slots=True)
class RallyBlock:
    """A block of rallies.

    Attributes:
        launches: (n, 11) float64: position, velocity, spin, drag factor, lift factor.
        seeds: (n,) uint64: all other random numbers of a rally follow from its seed.
        drawn: How many candidates were drawn for these n.
        paths: (n, m, 7) float64: recorded tracks that drive the balls until they are hit
            (``rally.step.snap_to_recorded_track``). None: physics alone moves them.
    """

    launches: Array
    seeds: Seeds
    drawn: int
    paths: Array | None = None

    @property
    def path_rows(self) -> int:
        """Return how many samples a recorded track may have; 0: there are no tracks."""
        return 0 if self.paths is None else self.paths.shape[1]

    def of(self, rows: npt.NDArray[np.int64]) -> "RallyBlock":
        """Return the rallies of ``rows``."""
        paths = None if self.paths is None else self.paths[rows]
        return RallyBlock(self.launches[rows], self.seeds[rows], self.drawn, paths)


@kernel
def _quantile(curve: Curve, u: float) -> float:
    """Return the curve's value at ``u`` in [0, 1). Nothing beyond the first and last of LEVELS is drawn."""
    level = LEVELS[0] + (LEVELS[-1] - LEVELS[0]) * u
    k = 1
    while k < len(LEVELS) - 1 and level > LEVELS[k]:
        k += 1
    w = (level - LEVELS[k - 1]) / (LEVELS[k] - LEVELS[k - 1])
    return curve[k - 1] + w * (curve[k] - curve[k - 1])


@kernel
def _draw_each(curves: tuple[Curve, Curve, Curve], seed: int, counter: int) -> Vec:
    """Return one independent value of each curve."""
    return (
        _quantile(curves[0], uniform(seed, Stream.LAUNCH, counter)),
        _quantile(curves[1], uniform(seed, Stream.LAUNCH, counter + 1)),
        _quantile(curves[2], uniform(seed, Stream.LAUNCH, counter + 2)),
    )


@kernel
def _normal_cdf(score: float) -> float:
    """Return the standard normal distribution function."""
    return 0.5 * math.erfc(-score / math.sqrt(2.0))


@kernel
def _ball_spin(radius: float, seed: int, counter: int) -> Vec:
    """Return a spin that is uniform in a ball of ``radius`` and never zero [rad/s]."""
    up = between(-1.0, 1.0, seed, Stream.LAUNCH, counter)
    azimuth = between(-math.pi, math.pi, seed, Stream.LAUNCH, counter + 1)
    # 1 - u lies in (0, 1]
    rate = radius * np.cbrt(1.0 - uniform(seed, Stream.LAUNCH, counter + 2))
    across = rate * math.sqrt(1.0 - up * up)
    return (across * math.cos(azimuth), across * math.sin(azimuth), rate * up)


@kernel
def _stroke(preset: Preset, seed: int) -> tuple[Vec, Vec]:
    """Return velocity and spin of a polar preset. The normal scores of speed and topspin are correlated."""
    score, other = normal_pair(seed, Stream.LAUNCH, 8)
    correlation = preset.topspin_by_speed
    topspin_score = correlation * score + math.sqrt(1.0 - correlation * correlation) * other
    speed = _quantile(preset.velocity[0], _normal_cdf(score))
    topspin = _quantile(preset.spin[0], _normal_cdf(topspin_score))
    _, elevation, azimuth = _draw_each(preset.velocity, seed, 3)
    _, sidespin, corkscrew = _draw_each(preset.spin, seed, 6)
    direction = (-math.cos(azimuth), math.sin(azimuth), 0.0)
    across = cross((0.0, 0.0, 1.0), direction)
    flat_speed = speed * math.cos(elevation)
    return (
        (flat_speed * direction[0], flat_speed * direction[1], speed * math.sin(elevation)),
        (
            topspin * across[0] + corkscrew * direction[0],
            topspin * across[1] + corkscrew * direction[1],
            sidespin,
        ),
    )


@kernel
def launch(preset: Preset, profile: RandomizationProfile, seed: int) -> tuple[Vec, Vec, Vec, float, float]:
    """Return position, velocity, spin, drag and lift factor of the launch with this seed. It may be invalid."""
    position = _draw_each(preset.position, seed, 0)
    if preset.polar:
        velocity, spin = _stroke(preset, seed)
    else:
        velocity = _draw_each(preset.velocity, seed, 3)
        mild, strong = preset.spin_radii
        spin = _ball_spin(mild if uniform(seed, Stream.LAUNCH, 11) < 0.5 else strong, seed, 6)
    drag_factor = between(profile.drag_factor[0], profile.drag_factor[1], seed, Stream.LAUNCH, 9)
    lift_factor = between(profile.lift_factor[0], profile.lift_factor[1], seed, Stream.LAUNCH, 10)
    return position, velocity, spin, drag_factor, lift_factor


@kernel
def is_valid(position: Vec, velocity: Vec, spin: Vec, air: Air, no_robot: RobotPath) -> bool:
    """Return whether the ball starts in free air, crosses the net, and its first touch is the robot's court."""
    if touch.table_gap(position)[0] <= 0.0 or touch.net_gap(position)[0] <= 0.0:
        return False
    verdict = coarse_verdict(position, velocity, spin, air)
    if verdict != UNSURE:
        return verdict == VALID
    _, _, _, what, _ = fly_to_touch(position, velocity, spin, LONGEST_FLIGHT, air, no_robot)
    return what == touch.ROBOT_COURT


class _BlockKey(NamedTuple):
    """What determines a block of launches, for kernels."""

    preset: Preset
    profile: RandomizationProfile
    seed: np.uint64
    shard: int
    block: int
    purpose: int
    model: int  # ``flight.SIMPLE`` or ``flight.FULL``


@kernel
def _fill(
    key: _BlockKey, valid_only: bool, most: int, no_robot: RobotPath, launches: Array, seeds: Seeds
) -> tuple[int, int]:
    """Fill the arrays from their first row on. Return how many rows are filled, and how many candidates were drawn."""
    preset, profile, seed, shard, block, purpose, model = key
    block_bits = bits(seed, shard, block)
    filled = 0
    drawn = 0
    while filled < len(seeds) and drawn < most:
        seeds[filled] = (bits(block_bits, purpose, drawn) >> np.uint64(2)) | (
            np.uint64(purpose) << np.uint64(62)
        )
        rally = seeds[filled]
        drawn += 1
        position, velocity, spin, drag_factor, lift_factor = launch(preset, profile, rally)
        air = Air(drag_factor, lift_factor, model)
        if valid_only and not is_valid(position, velocity, spin, air, no_robot):
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
    task: TaskConfig = TaskConfig(),
    *,
    seed: int,
    shard: int = 0,
    block: int = 0,
    purpose: Purpose = Purpose.TRAINING,
) -> RallyBlock:
    """Return a block of ``n`` valid rallies. The same arguments give the same bits in every process.

    With ``Purpose.FALLBACK`` no rally is validated: every launch of the preset is taken.

    Args:
        n: Rallies in the block.
        task: Its launch preset, randomization (the ranges of drag and lift) and flight are used. Two randomizations
            give the same launches, except for rallies that the air makes invalid.
        seed: Seed of the run, 0 .. 2^64 - 1.
        shard: Index of a series of blocks in the run.
        block: Index of the block in its shard. Two blocks of one seed share no rally.
        purpose: Rallies of different purposes never share a seed.

    Raises:
        ValueError: The share of valid launches is below ``FEWEST_VALID``.
    """
    launches = np.empty((n, LAUNCH_SIZE))
    seeds = np.empty(n, np.uint64)
    key = _BlockKey(
        PRESETS[task.launch],
        PROFILES[task.randomization],
        # A NumPy scalar: half of all seeds are too large for the int64 that numba makes of a Python int
        np.array([seed], np.uint64)[0],
        shard,
        block,
        int(purpose),
        int(task.flight_model),
    )
    most = math.ceil(n / FEWEST_VALID)
    filled, drawn = _fill(key, purpose != Purpose.FALLBACK, most, NO_ROBOT, launches, seeds)
    if filled < n:
        raise ValueError(
            f"launch preset {task.launch!r}: {filled} valid rallies in {drawn} candidates, wanted {n}"
        )
    return RallyBlock(launches, seeds, drawn)
