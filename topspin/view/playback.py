"""The clock of a ball's show: the robot takes its start position, the ball flies, and the last picture is held."""

from dataclasses import dataclass, replace
from typing import Final

APPROACH_S: Final = 0.6  # the robot moves from where the last ball left it to its start position
HOLD_S: Final = 1.2  # the outcome can be read
LONGEST_STEP_S: Final = 0.1  # a longer pause of the program is not caught up: the show only gets slower


@dataclass(frozen=True, slots=True)
class Playback:
    """Where a show is."""

    end: float  # [s] of the ball's flight
    time: float = -APPROACH_S  # [s] since the launch
    is_paused: bool = False
    speed: float = 1.0  # [-] of real time

    @property
    def is_over(self) -> bool:
        """Whether the next ball is due."""
        return self.time >= self.end + HOLD_S

    @property
    def approach(self) -> float:
        """Share of the way to its start position that the robot has made: 0 to 1, at rest at both ends."""
        share = min(max(1.0 + self.time / APPROACH_S, 0.0), 1.0)
        return share * share * (3.0 - 2.0 * share)

    def after(self, passed: float) -> "Playback":
        """Return the show ``passed`` seconds of real time later; slow motion holds only while the ball flies."""
        if self.is_paused:
            return self
        left = min(passed, LONGEST_STEP_S)
        time = self.time
        for start, stop, speed in (
            (-APPROACH_S, 0.0, 1.0),
            (0.0, self.end, self.speed),
            (self.end, self.end + HOLD_S, 1.0),
        ):
            if left > 0.0 and start <= time < stop:
                step = min(left, (stop - time) / speed)
                time = stop if step * speed >= stop - time else time + step * speed
                left -= step
        return replace(self, time=time)


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast shows ran lately, smoothed over about a second."""

    speed: float = 1.0  # [-] of real time
    rate_hz: float = 0.0  # pictures per second

    def after(self, shown: float, passed: float) -> "Pace":
        """Return the pace after a picture that showed ``shown`` seconds of flight in ``passed`` seconds."""
        if passed <= 0.0:
            return self
        weight = min(passed, 1.0)
        rate = 1.0 / passed if self.rate_hz == 0.0 else self.rate_hz + weight * (1.0 / passed - self.rate_hz)
        return Pace(self.speed + weight * (shown / passed - self.speed), rate)
