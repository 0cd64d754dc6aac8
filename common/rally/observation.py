"""What the policy sees and does: the 37 numbers and the 7, by name, unit and range.

``python -m common.rally.observation`` prints the tables as Markdown: docs/observation.md is that text.
"""

import sys
from typing import NamedTuple

from common.rally.trajectory import State


class Part(NamedTuple):
    """A contiguous part of a vector."""

    name: str
    size: int
    unit: str
    low: float  # smallest value that play can produce; a wider one is clipped by the normaliser, not lost
    high: float
    meaning: str


OBSERVATION: tuple[Part, ...] = (
    Part("joint_pos", 7, "m, rad", -3.2, 3.2, "rail_x, rail_y, yaw, pitch, elbow, wrist, roll"),
    Part("joint_vel", 7, "m/s, rad/s", -60.0, 60.0, "the same joints' velocities"),
    Part("racket_pos", 3, "m", -3.0, 2.0, "racket centre, world"),
    Part("racket_quat", 4, "-", -1.0, 1.0, "racket frame (w, x, y, z), w >= 0, near (1, 0, 0, 0) at home"),
    Part("racket_vel", 3, "m/s", -15.0, 15.0, "racket centre's velocity, world"),
    Part("ball_pos", 3, "m", -4.0, 4.0, "ball as perceived: late, noisy, sometimes held"),
    Part("ball_vel", 3, "m/s", -40.0, 40.0, "ball's velocity as perceived"),
    Part("target", 2, "m", -0.7425, 1.35, "where to land: x, y on the opponent's court"),
    Part("trajectory_state", 1, "-", -1.0, 1.0, "2s/3 - 1; s: 0 launched, 1 bounced, 2 hit, 3 landed"),
    Part("continuous_state", 4, "-", 0.0, 1.0, "one-hot over tau_01, tau_12, tau_23, tau_30"),
)
"""The paper's observation, in its order (it prints "racket position (7)"; only 3 sums to 37)."""

ACTION: tuple[Part, ...] = (
    Part("joint_target", 7, "half-range", -1.0, 1.0, "each joint's absolute target: middle + a x half-range"),
)


def size(layout: tuple[Part, ...]) -> int:
    """Return how many numbers a layout holds."""
    return sum(part.size for part in layout)


def offsets(layout: tuple[Part, ...]) -> dict[str, slice]:
    """Return where each part stands."""
    start, found = 0, {}
    for part in layout:
        found[part.name] = slice(start, start + part.size)
        start += part.size
    return found


OBSERVATION_SIZE = size(OBSERVATION)
ACTION_SIZE = size(ACTION)

CONTINUING = (State.TAU_01, State.TAU_12, State.TAU_23, State.TAU_30)
"""The one-hot's order; an instant state shows as the one it continues as."""


def markdown() -> str:
    """Return both layouts as the text of docs/observation.md."""
    lines = [
        "# Observation and action",
        "",
        "World frame: origin at the centre of the table top, x from the robot to the opponent, y to the robot's left,",
        "z up.",
        "Generated: `python -m common.rally.observation > docs/observation.md`.",
    ]
    for title, layout in (("Observation", OBSERVATION), ("Action", ACTION)):
        lines += [
            "",
            f"## {title}: {size(layout)} numbers",
            "",
            "| index | name | unit | range | is |",
            "|---|---|---|---|---|",
        ]
        for name, where in offsets(layout).items():
            part = next(part for part in layout if part.name == name)
            index = f"{where.start}-{where.stop - 1}" if part.size > 1 else str(where.start)
            lines.append(
                f"| {index} | {name} | {part.unit} | {part.low:g} to {part.high:g} | {part.meaning} |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(markdown())
