"""Counter-based random numbers: every number is a pure function of (seed, stream, counter).

The random numbers of a rally depend on its own seed only. They do not depend on the batch in which it is played, nor on
the numbers drawn before. So a batch equals its rallies played one by one, and a replay has the same table, rubber,
camera noise and latency (ADR-0002).

The mixer is SplitMix64 (Steele, Lea, Flood 2014, "Fast splittable pseudorandom number generators").
"""

import math
from enum import IntEnum

import numpy as np

from common.jit import kernel

Bits = int | np.uint64


class Stream(IntEnum):
    """What a number is for. Each use has its own stream, so two uses never share a number."""

    LAUNCH = 1
    TARGET = 2
    TABLE = 3
    RUBBER = 4
    GAINS = 5
    LATENCY = 6
    CAMERA = 7
    BURST = 8
    RESET = 9
    DETECTION = 10
    OUTLIER = 11
    KIND = 12


_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@kernel
def mix(z: Bits) -> np.uint64:
    """Return 64 well-mixed bits of ``z``. The map is a bijection."""
    z = np.uint64(z)
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@kernel
def bits(seed: Bits, stream: int, counter: int) -> np.uint64:
    """Return 64 random bits."""
    return mix(mix(np.uint64(seed) + np.uint64(stream) * _GAMMA) + np.uint64(counter) * _GAMMA)


@kernel
def uniform(seed: Bits, stream: int, counter: int) -> float:
    """Return a float in [0, 1)."""
    return float(bits(seed, stream, counter) >> _S11) * 1.1102230246251565e-16


@kernel
def between(low: float, high: float, seed: Bits, stream: int, counter: int) -> float:
    """Return a float, uniform in [low, high)."""
    return low + (high - low) * uniform(seed, stream, counter)


@kernel
def normal_pair(seed: Bits, stream: int, counter: int) -> tuple[float, float]:
    """Return two independent standard normal floats (Box-Muller). Uses counters 2k and 2k + 1, k = ``counter``."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, stream, 2 * counter)))
    angle = 2.0 * math.pi * uniform(seed, stream, 2 * counter + 1)
    return radius * math.cos(angle), radius * math.sin(angle)
