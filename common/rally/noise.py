"""What differs from rally to rally: one literal table of noise profiles, and how conditions are drawn."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import GRID_STEP, INVERTED, TABLE_FRICTION, TABLE_RESTITUTION0
from common.rally.draws import Stream, between, uniform

Array = npt.NDArray[np.float64]
Range = tuple[float, float]

CAMERA_RATE_HZ = 180.0  # [Hz] bursts of lost samples are counted in samples of this camera


class NoiseProfile(NamedTuple):
    """Ranges of everything randomised; each is drawn uniformly once a rally unless said otherwise."""

    drag_factor: Range  # [-] kept with the rally
    lift_factor: Range  # [-] kept with the rally
    table_restitution0: Range  # [-]
    table_friction: Range  # [-]
    racket_restitution0: Range  # [-]
    racket_restitution_slope: Range  # [s/m]
    racket_alpha: Range  # [-]
    racket_spin_loss: Range  # [-]
    gain_factor: Range  # [-] of each joint's kp, kv and damping
    observation_latency: Range  # [s] of the ball's samples
    action_latency: Range  # [s]
    position_noise: float  # [m] sigma of each sample and axis
    velocity_noise: float  # [m/s] sigma of each sample and axis
    loss: float  # [-] share of samples lost; the last one is held
    burst_share: float  # [-] share of rallies with a burst of lost samples
    burst_samples: Range  # length of a burst [camera samples]
    camera_rate_hz: float  # [Hz] the simulated camera (perception full); at most 200
    camera_jitter: (
        float  # [s] sigma of each shot's moment about the rate's; its time stamp is the true moment
    )
    camera_noise: float  # [m] sigma of each shot and axis
    outlier_share: float  # [-] share of shots that are gross errors
    outlier_size: float  # [m] a gross error is uniform in +- this, per axis


_RUBBER = ((0.85, 0.93), (0.015, 0.023), (0.64, 0.76), (0.0, 0.25))

PROFILES: dict[str, NoiseProfile] = {
    "off": NoiseProfile(
        (1.0, 1.0),
        (1.0, 1.0),
        (TABLE_RESTITUTION0, TABLE_RESTITUTION0),
        (TABLE_FRICTION, TABLE_FRICTION),
        (INVERTED.restitution0, INVERTED.restitution0),
        (INVERTED.restitution_slope, INVERTED.restitution_slope),
        (INVERTED.alpha, INVERTED.alpha),
        (INVERTED.spin_loss, INVERTED.spin_loss),
        (1.0, 1.0),
        (0.0, 0.0),
        (0.0, 0.0),
        0.0,
        0.0,
        0.0,
        0.0,
        (0.0, 0.0),
        CAMERA_RATE_HZ,
        0.0,
        0.0,
        0.0,
        0.0,
    ),
    "standard": NoiseProfile(
        (0.85, 1.15),
        (0.8, 1.2),
        (0.95, 1.0),
        (0.20, 0.30),
        *_RUBBER,
        (0.9, 1.1),
        (0.010, 0.040),
        (0.0, 0.010),
        0.003,
        0.08,
        0.03,
        0.05,
        (5.0, 15.0),
        CAMERA_RATE_HZ,
        0.0007,
        0.002,
        0.005,
        0.3,
    ),
    "hard": NoiseProfile(
        (0.75, 1.25),
        (0.6, 1.4),
        (0.90, 1.0),
        (0.15, 0.35),
        (0.80, 0.95),
        (0.012, 0.026),
        (0.58, 0.80),
        (0.0, 0.35),
        (0.8, 1.2),
        (0.020, 0.040),
        (0.0, 0.020),
        0.006,
        0.16,
        0.06,
        0.15,
        (5.0, 15.0),
        CAMERA_RATE_HZ,
        0.0007,
        0.004,
        0.01,
        0.5,
    ),
}
"""Profiles by name; ``standard`` is on in training and in every headline figure."""


class Condition(IntEnum):
    """Columns of a rally's conditions: drawn from its seed when it is played, but for drag and lift."""

    DRAG = 0
    LIFT = 1
    TABLE_RESTITUTION0 = 2
    TABLE_FRICTION = 3
    RACKET_RESTITUTION0 = 4
    RACKET_SLOPE = 5
    RACKET_ALPHA = 6
    RACKET_SPIN_LOSS = 7
    TARGET_X = 8
    TARGET_Y = 9
    LATENCY = 10  # [grid steps] of the ball's samples
    ACTION_LATENCY = 11  # [s]
    BURST_START = 12  # [s] since launch
    BURST_END = 13  # [s]


CONDITIONS = len(Condition)
TARGET_X: Range = (0.10, 1.35)  # [m] where targets lie on the opponent's court
TARGET_Y: Range = (-0.7425, 0.7425)  # [m]
MAX_LATENCY_STEPS = 8  # [grid steps] 40 ms: how far back the camera ring must reach

_TARGET, _TABLE, _RACKET = int(Stream.TARGET), int(Stream.TABLE), int(Stream.RUBBER)
_LATENCY, _BURST = int(Stream.LATENCY), int(Stream.BURST)


@kernel
def draw_conditions(
    seed: int, drag_factor: float, lift_factor: float, noise: NoiseProfile, out: Array
) -> None:
    """Write a rally's conditions into ``out`` (14,), a pure function of its seed.

    Target, table and racket act after validity is decided: unlike the launch they aren't kept with the rally.
    """
    out[0], out[1] = drag_factor, lift_factor
    out[2] = between(noise.table_restitution0[0], noise.table_restitution0[1], seed, _TABLE, 0)
    out[3] = between(noise.table_friction[0], noise.table_friction[1], seed, _TABLE, 1)
    out[4] = between(noise.racket_restitution0[0], noise.racket_restitution0[1], seed, _RACKET, 0)
    out[5] = between(noise.racket_restitution_slope[0], noise.racket_restitution_slope[1], seed, _RACKET, 1)
    out[6] = between(noise.racket_alpha[0], noise.racket_alpha[1], seed, _RACKET, 2)
    out[7] = between(noise.racket_spin_loss[0], noise.racket_spin_loss[1], seed, _RACKET, 3)
    out[8] = between(TARGET_X[0], TARGET_X[1], seed, _TARGET, 0)
    out[9] = between(TARGET_Y[0], TARGET_Y[1], seed, _TARGET, 1)
    late = between(noise.observation_latency[0], noise.observation_latency[1], seed, _LATENCY, 0)
    # Nearest grid sample: a blend of samples on both sides of a bounce would show a ball that never was.
    out[10] = min(float(int(late / GRID_STEP + 0.5)), float(MAX_LATENCY_STEPS))
    out[11] = between(noise.action_latency[0], noise.action_latency[1], seed, _LATENCY, 1)
    out[12], out[13] = -1.0, -1.0
    if uniform(seed, _BURST, 0) < noise.burst_share:
        samples = between(noise.burst_samples[0], noise.burst_samples[1], seed, _BURST, 1)
        out[12] = between(0.0, 0.6, seed, _BURST, 2)
        out[13] = out[12] + samples / CAMERA_RATE_HZ
