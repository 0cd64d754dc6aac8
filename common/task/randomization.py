"""What differs from rally to rally: the profiles as one literal table, and how a rally's parameters are drawn."""

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import (
    BALL_RADIUS,
    GRID_STEP,
    INVERTED,
    RUBBERS,
    TABLE_FRICTION,
    TABLE_RESTITUTION0,
    Rubber,
)
from common.physics.flight import Air
from common.physics.vec import Vec, norm
from common.task.counter_rng import Stream, between, uniform

Array = npt.NDArray[np.float64]
Range = tuple[float, float]

SLOW_FROM, SLOW_TO = 0.25, 0.5  # [-] spin parameters between which the range of backspin's lift widens
CAMERA_RATE_HZ = 180.0  # [Hz] the length of a burst of lost samples is counted in samples of this camera


class RandomizationProfile(NamedTuple):
    """Ranges of what differs between rallies. Each range gives one uniform number a rally, unless noted."""

    drag_factor: Range  # [-] drawn with the launch
    lift_factor: Range  # [-] drawn with the launch
    # [-] added to the upper limit of the lift factor of slow backspin: ``air_factors``
    backspin_lift: float
    table_restitution0: Range  # [-]
    table_friction: Range  # [-]
    racket_restitution0: Range  # [-]
    racket_restitution_slope: Range  # [s/m]
    racket_alpha: Range  # [-]
    racket_spin_loss: Range  # [-]
    racket_friction: float  # [-] of the rubber; inf: it never slides
    racket_friction_factor: Range  # [-] multiplies it
    gain_factor: Range  # [-] one number each for kp, kv and damping of each joint
    observation_latency: Range  # [s] of the ball's samples
    action_latency: Range  # [s]
    position_noise: float  # [m] standard deviation, per sample and axis
    velocity_noise: float  # [m/s] standard deviation, per sample and axis
    loss: float  # [-] share of samples that are lost; the last sample is held
    burst_share: float  # [-] share of rallies with a burst of lost samples
    burst_samples: Range  # [camera samples] length of a burst
    camera_rate_hz: float  # [Hz] rate of the simulated camera (perception full); at most 200
    # [s] standard deviation of a detection's moment about the camera's regular times; its time stamp is the true moment
    camera_jitter: float
    camera_noise: float  # [m] standard deviation, per detection and axis
    outlier_share: float  # [-] share of detections that are gross errors
    outlier_size: float  # [m] a gross error is uniform in plus or minus this, per axis


PROFILES: dict[str, RandomizationProfile] = {
    "off": RandomizationProfile(
        drag_factor=(1.0, 1.0),
        lift_factor=(1.0, 1.0),
        backspin_lift=0.0,
        table_restitution0=(TABLE_RESTITUTION0, TABLE_RESTITUTION0),
        table_friction=(TABLE_FRICTION, TABLE_FRICTION),
        racket_restitution0=(INVERTED.restitution0, INVERTED.restitution0),
        racket_restitution_slope=(INVERTED.restitution_slope, INVERTED.restitution_slope),
        racket_alpha=(INVERTED.alpha, INVERTED.alpha),
        racket_spin_loss=(INVERTED.spin_loss, INVERTED.spin_loss),
        racket_friction=INVERTED.friction,
        racket_friction_factor=(1.0, 1.0),
        gain_factor=(1.0, 1.0),
        observation_latency=(0.0, 0.0),
        action_latency=(0.0, 0.0),
        position_noise=0.0,
        velocity_noise=0.0,
        loss=0.0,
        burst_share=0.0,
        burst_samples=(0.0, 0.0),
        camera_rate_hz=CAMERA_RATE_HZ,
        camera_jitter=0.0,
        camera_noise=0.0,
        outlier_share=0.0,
        outlier_size=0.0,
    ),
    "standard": RandomizationProfile(
        drag_factor=(0.85, 1.15),
        lift_factor=(0.8, 1.2),
        backspin_lift=0.6,
        table_restitution0=(0.95, 1.0),
        table_friction=(0.20, 0.30),
        racket_restitution0=(0.85, 0.93),
        racket_restitution_slope=(0.015, 0.023),
        racket_alpha=(0.64, 0.76),
        racket_spin_loss=(0.0, 0.25),
        racket_friction=INVERTED.friction,
        racket_friction_factor=(0.8, 1.2),
        gain_factor=(0.9, 1.1),
        observation_latency=(0.010, 0.040),
        action_latency=(0.0, 0.010),
        position_noise=0.003,
        velocity_noise=0.08,
        loss=0.03,
        burst_share=0.05,
        burst_samples=(5.0, 15.0),
        camera_rate_hz=CAMERA_RATE_HZ,
        camera_jitter=0.0007,
        camera_noise=0.002,
        outlier_share=0.005,
        outlier_size=0.3,
    ),
    "hard": RandomizationProfile(
        drag_factor=(0.75, 1.25),
        lift_factor=(0.6, 1.4),
        backspin_lift=0.4,
        table_restitution0=(0.90, 1.0),
        table_friction=(0.15, 0.35),
        racket_restitution0=(0.80, 0.95),
        racket_restitution_slope=(0.012, 0.026),
        racket_alpha=(0.58, 0.80),
        racket_spin_loss=(0.0, 0.35),
        racket_friction=INVERTED.friction,
        racket_friction_factor=(0.6, 1.4),
        gain_factor=(0.8, 1.2),
        observation_latency=(0.020, 0.040),
        action_latency=(0.0, 0.020),
        position_noise=0.006,
        velocity_noise=0.16,
        loss=0.06,
        burst_share=0.15,
        burst_samples=(5.0, 15.0),
        camera_rate_hz=CAMERA_RATE_HZ,
        camera_jitter=0.0007,
        camera_noise=0.004,
        outlier_share=0.01,
        outlier_size=0.5,
    ),
}
"""Profiles by name, for inverted rubber. Training and every headline figure use ``standard``."""


def profile_of(name: str, rubber: str = "inverted") -> RandomizationProfile:
    """Return the profile for a racket with this rubber.

    Each range of the racket is scaled by the ratio of the rubber's published value to that of inverted rubber: it is as
    wide in percent, and never negative. The friction is the rubber's own, and its factor varies as the table's
    friction does.

    Args:
        name: Key of ``PROFILES``.
        rubber: Key of ``constants.RUBBERS``.
    """
    profile, covering = PROFILES[name], RUBBERS[rubber]

    def scaled(limits: Range, value: float, inverted: float) -> Range:
        ratio = value / inverted  # exactly 1 for inverted rubber, whose ranges keep their bits
        return limits[0] * ratio, limits[1] * ratio

    return profile._replace(
        racket_restitution0=scaled(profile.racket_restitution0, covering.restitution0, INVERTED.restitution0),
        racket_restitution_slope=scaled(
            profile.racket_restitution_slope, covering.restitution_slope, INVERTED.restitution_slope
        ),
        racket_alpha=scaled(profile.racket_alpha, covering.alpha, INVERTED.alpha),
        racket_spin_loss=scaled(profile.racket_spin_loss, covering.spin_loss, INVERTED.spin_loss),
        racket_friction=covering.friction,
    )


class RallyParameter(IntEnum):
    """Columns of a rally's parameters. Drag, lift and kind come with the launch. The others follow from the seed."""

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
    RACKET_FRICTION = 14  # inf: the rubber never slides
    KIND = 15  # launch_presets.Kind of the ball; comes with the launch


RALLY_PARAMETERS = len(RallyParameter)
TARGET_X_RANGE: Range = (0.10, 1.35)  # [m] targets on the opponent's court
TARGET_Y_RANGE: Range = (-0.7425, 0.7425)  # [m]
MAX_LATENCY_STEPS = 12  # [grid steps] 60 ms: the ring of true samples reaches back so far

_P = RallyParameter
_LAUNCH = int(Stream.LAUNCH)
_TARGET, _TABLE, _RACKET = int(Stream.TARGET), int(Stream.TABLE), int(Stream.RUBBER)
_LATENCY, _BURST = int(Stream.LATENCY), int(Stream.BURST)


@kernel
def air_of(parameters: Array, model: int) -> Air:
    """Return the air of a rally with these parameters (16,). ``model`` is ``flight.SIMPLE`` or ``flight.FULL``."""
    return Air(parameters[_P.DRAG], parameters[_P.LIFT], model)


@kernel
def rubber_of(parameters: Array) -> Rubber:
    """Return the racket's rubber in a rally with these parameters (16,)."""
    return Rubber(
        parameters[_P.RACKET_RESTITUTION0],
        parameters[_P.RACKET_SLOPE],
        parameters[_P.RACKET_ALPHA],
        parameters[_P.RACKET_SPIN_LOSS],
        parameters[_P.RACKET_FRICTION],
    )


@kernel
def air_factors(velocity: Vec, spin: Vec, profile: RandomizationProfile, seed: int) -> tuple[float, float]:
    """Return drag and lift factor of a launch, from its seed.

    Recorded strokes of amateurs with backspin need more lift than the models have, the more, the larger the spin
    parameter S = r|w|/|v| is: at S near 0.8 1.24 times as much in the median, and 1.78 times at the 95th percentile. So
    the upper limit of the lift factor rises from S = 0.25 to S = 0.5, for the share of the spin that is backspin.

    Args:
        velocity: Of the launch [m/s].
        spin: Of the launch [rad/s].
        profile: Ranges of the factors.
        seed: Of the rally.
    """
    flat = math.hypot(velocity[0], velocity[1])
    rate, speed = norm(spin), norm(velocity)
    most = profile.lift_factor[1]
    if flat > 0.0 and rate > 0.0:
        backspin = max(spin[0] * velocity[1] - spin[1] * velocity[0], 0.0) / (flat * rate)
        slowness = (BALL_RADIUS * rate / speed - SLOW_FROM) / (SLOW_TO - SLOW_FROM)
        most += profile.backspin_lift * backspin * min(max(slowness, 0.0), 1.0)
    return (
        between(profile.drag_factor[0], profile.drag_factor[1], seed, _LAUNCH, 9),
        between(profile.lift_factor[0], most, seed, _LAUNCH, 10),
    )


@kernel
def table_of(profile: RandomizationProfile, seed: int) -> tuple[float, float]:
    """Return restitution and friction of the table in the rally with this seed [-]."""
    p = profile
    return (
        between(p.table_restitution0[0], p.table_restitution0[1], seed, _TABLE, 0),
        between(p.table_friction[0], p.table_friction[1], seed, _TABLE, 1),
    )


@kernel
def draw_parameters(
    seed: int, drag_factor: float, lift_factor: float, kind: float, profile: RandomizationProfile, out: Array
) -> None:
    """Write a rally's parameters into ``out`` (16,): a pure function of its launch and its seed.

    Target and racket have no effect on whether the launch is valid. So they are drawn here and are not sent.
    """
    p = profile
    out[_P.DRAG], out[_P.LIFT], out[_P.KIND] = drag_factor, lift_factor, kind
    out[_P.TABLE_RESTITUTION0], out[_P.TABLE_FRICTION] = table_of(profile, seed)
    out[_P.RACKET_RESTITUTION0] = between(
        p.racket_restitution0[0], p.racket_restitution0[1], seed, _RACKET, 0
    )
    out[_P.RACKET_SLOPE] = between(
        p.racket_restitution_slope[0], p.racket_restitution_slope[1], seed, _RACKET, 1
    )
    out[_P.RACKET_ALPHA] = between(p.racket_alpha[0], p.racket_alpha[1], seed, _RACKET, 2)
    out[_P.RACKET_SPIN_LOSS] = between(p.racket_spin_loss[0], p.racket_spin_loss[1], seed, _RACKET, 3)
    factor = between(p.racket_friction_factor[0], p.racket_friction_factor[1], seed, _RACKET, 4)
    out[_P.RACKET_FRICTION] = p.racket_friction * factor
    out[_P.TARGET_X] = between(TARGET_X_RANGE[0], TARGET_X_RANGE[1], seed, _TARGET, 0)
    out[_P.TARGET_Y] = between(TARGET_Y_RANGE[0], TARGET_Y_RANGE[1], seed, _TARGET, 1)
    late = between(p.observation_latency[0], p.observation_latency[1], seed, _LATENCY, 0)
    # The nearest grid sample: a mix of samples before and after a bounce would show a ball that never existed.
    out[_P.LATENCY] = min(float(int(late / GRID_STEP + 0.5)), float(MAX_LATENCY_STEPS))
    out[_P.ACTION_LATENCY] = between(p.action_latency[0], p.action_latency[1], seed, _LATENCY, 1)
    out[_P.BURST_START], out[_P.BURST_END] = -1.0, -1.0
    if uniform(seed, _BURST, 0) < p.burst_share:
        samples = between(p.burst_samples[0], p.burst_samples[1], seed, _BURST, 1)
        out[_P.BURST_START] = between(0.0, 0.6, seed, _BURST, 2)
        out[_P.BURST_END] = out[_P.BURST_START] + samples / CAMERA_RATE_HZ
