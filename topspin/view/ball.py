"""The ball that a person asks for with sliders: what it is, and whether a rally can start with it."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.physics import touch
from common.physics.flight import Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import Touch
from common.physics.vec import Vec
from common.task.config import TaskConfig
from common.task.launch import LONGEST_FLIGHT, RallyBlock, is_valid
from common.task.launch_presets import Kind
from common.task.randomization import air_factors, profile_of, table_of

Array = npt.NDArray[np.float64]


class Slider(NamedTuple):
    """One number of a ball, as its slider shows it."""

    label: str
    unit: str
    low: float
    high: float
    step: float
    start: float
    hint: str


SLIDERS: Final[dict[str, Slider]] = {
    "speed": Slider("Speed", "m/s", 2.0, 25.0, 0.1, 6.5, "speed at the launch"),
    "elevation": Slider("Upwards", "°", -40.0, 40.0, 0.5, 10.0, "above the horizontal; negative: downwards"),
    "azimuth": Slider("Sideways", "°", -35.0, 35.0, 0.5, 0.0, "positive: to the robot's right"),
    "topspin": Slider("Topspin", "rad/s", -800.0, 800.0, 5.0, 80.0, "negative: backspin"),
    "sidespin": Slider("Sidespin", "rad/s", -400.0, 400.0, 5.0, 0.0, "about the vertical axis"),
    "corkscrew": Slider("Corkscrew", "rad/s", -200.0, 200.0, 5.0, 0.0, "about the direction of flight"),
    "x": Slider(
        "From the net",
        "m",
        0.1,
        3.2,
        0.01,
        1.3,
        "distance of the launch from the net; the table ends at 1.37",
    ),
    "y": Slider("Across", "m", -0.9, 0.9, 0.01, 0.0, "place across the table; its middle is 0"),
    "z": Slider("Height", "m", -0.3, 0.9, 0.01, 0.30, "above the table"),
}
"""The fields of ``ServedBall``, in its order."""


@dataclass(frozen=True, slots=True)
class ServedBall:
    """A launch in a person's words. Spin is positive as in ``launch_presets.QUANTITIES``."""

    speed: float  # [m/s]
    elevation: float  # [degrees]
    azimuth: float  # [degrees] from -x towards y
    topspin: float  # [rad/s]
    sidespin: float  # [rad/s]
    corkscrew: float  # [rad/s]
    x: float  # [m]
    y: float  # [m]
    z: float  # [m]


START: Final = ServedBall(*(slider.start for slider in SLIDERS.values()))


@dataclass(frozen=True, slots=True)
class Judged:
    """A ball that may be served, or the reason why not."""

    block: RallyBlock | None  # its one rally; None: it may not
    text: str


# What is wrong with a ball that first touches this, and with one that has bounced on its own court first
_BEFORE: Final[dict[Touch, str]] = {
    Touch.NONE: "it is in the air for more than 2 s",
    Touch.NET: "it touches the net",
    Touch.EDGE: "it touches an edge of the table",
    Touch.FLOOR: "it misses the table",
    Touch.OUT: "it misses the table",
}
_AFTER: Final[dict[Touch, str]] = {
    Touch.NONE: "after its own court it is in the air for more than 2 s",
    Touch.OPPONENT_COURT: "it bounces twice on its own court",
    Touch.NET: "it bounces on its own court and then touches the net",
    Touch.EDGE: "it bounces on its own court and then touches an edge",
    Touch.FLOOR: "it bounces on its own court and then misses the robot's",
    Touch.OUT: "it bounces on its own court and then misses the robot's",
}


def _vectors(ball: ServedBall) -> tuple[Vec, Vec, Vec]:
    """Return position [m], velocity [m/s] and spin [rad/s]."""
    elevation, azimuth = math.radians(ball.elevation), math.radians(ball.azimuth)
    forward = np.array([-math.cos(azimuth), math.sin(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    vel = ball.speed * (math.cos(elevation) * forward + math.sin(elevation) * up)
    spin = ball.topspin * np.cross(up, forward) + ball.corkscrew * forward + ball.sidespin * up
    return (ball.x, ball.y, ball.z), _vec(vel), _vec(spin)


def _vec(values: Array) -> Vec:
    x, y, z = (float(value) for value in values)
    return x, y, z


def ball_of(pos: Array, vel: Array, spin: Array) -> ServedBall:
    """Return a launch (3,) each in the sliders' words, each number within its slider and on its steps."""
    flat = math.hypot(vel[0], vel[1])
    forward = np.array([vel[0], vel[1], 0.0]) / max(flat, 1e-9)
    exact = (
        float(np.linalg.norm(vel)),
        math.degrees(math.atan2(vel[2], flat)),
        math.degrees(math.atan2(vel[1], -vel[0])),
        float(spin @ np.cross([0.0, 0.0, 1.0], forward)),
        float(spin[2]),
        float(spin @ forward),
        *(float(part) for part in pos),
    )
    return ServedBall(
        *(
            round(min(max(round(value / s.step) * s.step, s.low), s.high), 6)
            for value, s in zip(exact, SLIDERS.values(), strict=True)
        )
    )


def judge(ball: ServedBall, task: TaskConfig, seed: int) -> Judged:
    """Return the ball's rally if it is valid by the rule that generated balls follow (``launch.is_valid``).

    Args:
        ball: As the sliders say.
        task: Its randomization and flight are used.
        seed: Of the rally: air, table, target and noise follow from it.
    """
    pos, vel, spin = _vectors(ball)
    rally, profile = np.array([seed], np.uint64), profile_of(task.randomization, task.rubber)
    drag, lift = air_factors(vel, spin, profile, rally[0])
    air, table = Air(drag, lift, int(task.flight_model)), table_of(profile, rally[0])
    for kind, text in ((Kind.PAPER, "a ball of a rally"), (Kind.SERVE, "a serve")):
        if is_valid(pos, vel, spin, air, kind == Kind.SERVE, table, NO_ROBOT):
            launch = np.array([[*pos, *vel, *spin, drag, lift, float(kind)]])
            return Judged(RallyBlock(launch, rally, 1), f"valid: {text}")
    return Judged(None, f"not valid: {_fault(pos, vel, spin, air, table)}")


def _fault(pos: Vec, vel: Vec, spin: Vec, air: Air, table: tuple[float, float]) -> str:
    """Return why no rally starts with this ball."""
    if touch.table_gap(pos)[0] <= 0.0:
        return "it starts inside the table"
    if touch.net_gap(pos)[0] <= 0.0:
        return "it starts inside the net"
    pos, vel, _, what, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, NO_ROBOT)
    if what != touch.OPPONENT_COURT:
        return _BEFORE[Touch(what)]
    vel, spin = table_bounce(vel, spin, normal, *table)
    return _AFTER[Touch(fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, NO_ROBOT)[3])]
