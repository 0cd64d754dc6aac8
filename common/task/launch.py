"""Launches: how one is drawn from its kind and seed, and how blocks of valid rallies are drawn.

A rally is valid if the ball crosses the net without a touch and its first touch is the robot's court. A serve touches
the server's own court first, and then the robot's.

All random numbers of a rally come from its own 64-bit seed (``counter_rng``). Launch and air are drawn here. Target,
table and rubber are drawn when the rally is played. There is no generator state to keep or to lose. So a block of valid
rallies is a function of its arguments, and any launch can be drawn again from kind, randomization and seed.
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
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec, cross, norm
from common.task.coarse_flight import UNSURE, VALID, coarse_verdict
from common.task.config import TaskConfig
from common.task.counter_rng import Stream, between, bits, normal_pair, uniform
from common.task.launch_presets import KINDS, LEVELS, PRESETS, SERVE, Balls, Curve
from common.task.randomization import PROFILES, RandomizationProfile, air_factors, table_of

Array = npt.NDArray[np.float64]
Seeds = npt.NDArray[np.uint64]

# Columns of a launch. The seed is a separate array, because a float64 can't hold it
POSITION: Final = slice(0, 3)  # [m]
VELOCITY: Final = slice(3, 6)  # [m/s]
SPIN: Final = slice(6, 9)  # [rad/s]
DRAG_FACTOR: Final = 9  # [-]
LIFT_FACTOR: Final = 10  # [-]
KIND: Final = 11  # launch_presets.Kind
LAUNCH_SIZE: Final = 12

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
        launches: (n, 12) float64: position, velocity, spin, drag factor, lift factor, kind.
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
def _stroke(balls: Balls, seed: int) -> tuple[Vec, Vec, Vec]:
    """Return position, velocity and spin of a stroke: independent normal scores, made to correlate by the factor."""
    count = balls.factor.shape[0]
    scores, values = np.empty(count + 1), np.empty(count)
    for k in range(0, count, 2):
        scores[k], scores[k + 1] = normal_pair(seed, Stream.LAUNCH, 16 + k)
    curves = (
        *(balls.position[0], balls.position[1], balls.position[2]),
        *(balls.velocity[0], balls.velocity[1], balls.velocity[2]),
        *(balls.spin[0], balls.spin[1], balls.spin[2]),
    )
    for k in range(count):
        score = 0.0
        for j in range(k + 1):
            score += balls.factor[k, j] * scores[j]
        values[k] = _quantile(curves[k], _normal_cdf(score))
    speed, elevation, azimuth = values[3], values[4], values[5]
    topspin, sidespin, corkscrew = values[6], values[7], values[8]
    direction = (-math.cos(azimuth), math.sin(azimuth), 0.0)
    across = cross((0.0, 0.0, 1.0), direction)
    flat_speed = speed * math.cos(elevation)
    return (
        (values[0], values[1], values[2]),
        (flat_speed * direction[0], flat_speed * direction[1], speed * math.sin(elevation)),
        (
            topspin * across[0] + corkscrew * direction[0],
            topspin * across[1] + corkscrew * direction[1],
            sidespin,
        ),
    )


@kernel
def launch(balls: Balls, profile: RandomizationProfile, seed: int) -> tuple[Vec, Vec, Vec, float, float]:
    """Return position, velocity, spin, drag and lift factor of the launch with this seed. It may be invalid."""
    if balls.spin_radius > 0.0:
        position = _draw_each(balls.position, seed, 0)
        velocity = _draw_each(balls.velocity, seed, 3)
        spin = _ball_spin(balls.spin_radius, seed, 6)
    else:
        position, velocity, spin = _stroke(balls, seed)
    drag_factor, lift_factor = air_factors(velocity, spin, profile, seed)
    return position, velocity, spin, drag_factor, lift_factor


@kernel
def is_of_kind(balls: Balls, velocity: Vec, spin: Vec) -> bool:
    """Return whether a launch has the speed and the spin of its kind."""
    slow, fast = balls.speed_range
    return slow <= norm(velocity) <= fast and norm(spin) >= balls.least_spin


@kernel
def is_valid(
    position: Vec,
    velocity: Vec,
    spin: Vec,
    air: Air,
    is_serve: bool,
    table: tuple[float, float],
    no_robot: RobotPath,
) -> bool:
    """Return whether the ball starts in free air, crosses the net, and touches the right courts in the right order.

    Args:
        position: Of the launch [m].
        velocity: [m/s].
        spin: [rad/s].
        air: Of the rally.
        is_serve: Whether the ball must touch the opponent's court before it crosses the net.
        table: Restitution and friction of the table in the rally [-]; only a serve depends on it.
        no_robot: ``fly.NO_ROBOT``.
    """
    if touch.table_gap(position)[0] <= 0.0 or touch.net_gap(position)[0] <= 0.0:
        return False
    if is_serve:
        position, velocity, _, what, normal = fly_to_touch(
            position, velocity, spin, LONGEST_FLIGHT, air, no_robot
        )
        if what != touch.OPPONENT_COURT:
            return False
        velocity, spin = table_bounce(velocity, spin, normal, table[0], table[1])
    else:
        verdict = coarse_verdict(position, velocity, spin, air)
        if verdict != UNSURE:
            return verdict == VALID
    _, _, _, what, _ = fly_to_touch(position, velocity, spin, LONGEST_FLIGHT, air, no_robot)
    return what == touch.ROBOT_COURT


class _BlockKey(NamedTuple):
    """What determines a block of launches, for kernels."""

    shares: tuple[float, ...]  # of each of KINDS
    profile: RandomizationProfile
    seed: np.uint64
    shard: int
    block: int
    purpose: int
    model: int  # ``flight.SIMPLE`` or ``flight.FULL``


@kernel
def _draw_kind(shares: tuple[float, ...], u: float) -> int:
    """Return a kind, each with its share, for ``u`` in [0, 1)."""
    kind = 0
    for k in range(len(shares)):
        if shares[k] > 0.0:
            kind = k
            if u < shares[k]:
                break
            u -= shares[k]
    return kind


@kernel
def _fill(
    key: _BlockKey,
    kinds: tuple[Balls, ...],
    valid_only: bool,
    most: int,
    no_robot: RobotPath,
    launches: Array,
    seeds: Seeds,
) -> tuple[int, int]:
    """Fill the arrays from their first row on. Return how many rows are filled, and how many candidates were drawn."""
    shares, profile, seed, shard, block, purpose, model = key
    block_bits = bits(seed, shard, block)
    filled = 0
    drawn = 0
    while filled < len(seeds) and drawn < most:
        # Of the row, not of the candidate: so a kind of which few candidates are valid has its share of the block
        kind = _draw_kind(shares, uniform(block_bits, Stream.KIND, filled))
        balls = kinds[kind]
        seeds[filled] = (bits(block_bits, purpose, drawn) >> np.uint64(2)) | (
            np.uint64(purpose) << np.uint64(62)
        )
        rally = seeds[filled]
        drawn += 1
        position, velocity, spin, drag_factor, lift_factor = launch(balls, profile, rally)
        if not is_of_kind(balls, velocity, spin):
            continue
        is_serve = kind == SERVE
        air = Air(drag_factor, lift_factor, model)
        if valid_only and not is_valid(
            position, velocity, spin, air, is_serve, table_of(profile, rally), no_robot
        ):
            continue
        for k in range(3):
            launches[filled, k] = position[k]
            launches[filled, 3 + k] = velocity[k]
            launches[filled, 6 + k] = spin[k]
        launches[filled, DRAG_FACTOR] = drag_factor
        launches[filled, LIFT_FACTOR] = lift_factor
        launches[filled, KIND] = kind
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

    With ``Purpose.FALLBACK`` no rally is validated: every launch of the preset's kinds is taken.

    Args:
        n: Rallies in the block.
        task: Its launch preset, randomization (the ranges of drag and lift) and flight are used. Two randomizations
            give the same launches, except for rallies that the air, or a serve's table, makes invalid.
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
    filled, drawn = _fill(key, KINDS, purpose != Purpose.FALLBACK, most, NO_ROBOT, launches, seeds)
    if filled < n:
        raise ValueError(
            f"launch preset {task.launch!r}: {filled} valid rallies in {drawn} candidates, wanted {n}"
        )
    return RallyBlock(launches, seeds, drawn)
