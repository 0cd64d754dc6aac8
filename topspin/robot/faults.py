"""What is wrong with a measurement: bad numbers are named and counted, and never become joint targets."""

from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

MAX_AGE: Final = (
    0.5  # [s] a ball that was not detected for longer is lost; an older stamp is of another clock
)
AHEAD: Final = 0.02  # [s] by which a stamp may be ahead of the controller's clock


class Fault(StrEnum):
    """A kind of bad measurement, and how ``Controller.faults`` counts it."""

    BALL_BEFORE_BEGIN = "ball_before_begin"  # no ball is played yet: ``Controller.begin`` was not called
    BALL_NOT_FINITE = "ball_not_finite"
    BALL_OUT_OF_RANGE = "ball_out_of_range"  # of the contract: another frame or unit; or no trajectory state
    BALL_OUT_OF_ORDER = "ball_out_of_order"  # not newer than the one before
    BALL_CLOCK = "ball_clock"  # its stamp is ahead of the controller's clock, or too old
    JOINTS_NOT_FINITE = "joints_not_finite"
    JOINTS_OUT_OF_RANGE = "joints_out_of_range"
    CLOCK = "clock"  # the time of a step is not finite, or not later than that of the one before
    OBSERVATION_NOT_FINITE = "observation_not_finite"
    ACTION_NOT_FINITE = "action_not_finite"


class Found(NamedTuple):
    """A fault that was found, and the sentence that says what was got and what is allowed."""

    fault: Fault
    text: str


class Limits(NamedTuple):
    """Numbers that are checked together."""

    name: str
    low: float
    high: float
    not_finite: Fault
    out_of_range: Fault


def check_numbers(values: npt.ArrayLike, size: int, limits: Limits) -> Found | None:
    """Return what is wrong with measured numbers (size,), or None.

    Raises:
        ValueError: There are not ``size`` numbers: a mistake of the program, not of a sensor.
    """
    numbers = np.asarray(values, np.float64)
    if numbers.shape != (size,):
        raise ValueError(f"{limits.name} has shape {numbers.shape}; allowed: ({size},)")
    allowed = f"allowed: {limits.low:g} to {limits.high:g}"
    for k, value in enumerate(numbers.tolist()):
        if not np.isfinite(value):
            return Found(limits.not_finite, f"{limits.name}[{k}] is {value}; {allowed}")
        if not limits.low <= value <= limits.high:
            return Found(limits.out_of_range, f"{limits.name}[{k}] is {value:g}; {allowed}")
    return None


def check_stamp(moment: float, newest: float, now: float) -> Found | None:
    """Return what is wrong with the time stamp of a ball [s], or None.

    Args:
        moment: The stamp.
        newest: That of the ball before; -inf: it is the first.
        now: Time of the control step.
    """
    if not np.isfinite(moment):
        return Found(Fault.BALL_NOT_FINITE, f"ball moment is {moment}; allowed: a finite time")
    if not now - MAX_AGE <= moment <= now + AHEAD:
        return Found(
            Fault.BALL_CLOCK,
            f"ball moment is {moment - now:+.3f} s from the controller's clock; "
            f"allowed: {-MAX_AGE:+g} to {AHEAD:+g} s",
        )
    if moment <= newest:
        return Found(
            Fault.BALL_OUT_OF_ORDER,
            f"ball moment is {moment - newest:+.4f} s from the one before; allowed: a later one",
        )
    return None


def check_clock(now: float, before: float) -> Found | None:
    """Return what is wrong with the time of a control step [s], or None. ``before`` is that of the last step."""
    if np.isfinite(now) and now > before:
        return None
    return Found(Fault.CLOCK, f"now is {now}; allowed: a time later than {before}")
