"""What the policy sees and does: the 37 numbers and the 7, by name, unit and range.

``python -m common.rally.observation`` prints the tables as Markdown: docs/observation.md is that text.
"""

import sys
from typing import Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

Expectation = Literal["mild", "mixed", "strong", "learnt"]  # of spins: ``prediction.EXPECTED``


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

_FILTERED: Final = {
    "ball_pos": "where the ball is now, as its flight so far tells; once it is hit: as perceived",
    "ball_vel": "its velocity then",
}
"""Option ``ball: filtered``: what stands there then."""

SPIN: tuple[Part, ...] = (
    Part("ball_spin", 3, "rad/s", -1500.0, 1500.0, "the ball's true spin: no robot is told it"),
)
"""Option ``spin: true``: a ceiling to measure against."""

SPIN_ESTIMATE: tuple[Part, ...] = (
    Part(
        "spin_estimate",
        3,
        "rad/s",
        -1500.0,
        1500.0,
        "the ball's spin behind the bounce, as its flight so far tells it",
    ),
)
"""Option ``spin: estimated``: what a robot can find out by itself."""

PREDICTION: tuple[Part, ...] = (
    Part("present_ball_pos", 3, "m", -4.0, 4.0, "where the ball is now, as its flight so far tells"),
    Part("present_ball_vel", 3, "m/s", -40.0, 40.0, "its velocity now"),
    Part("meeting_in", 1, "s", -2.5, 1.2, "time until 0.12 s behind the bounce, about when it will be met"),
    Part("meeting_ball_pos", 3, "m", -8.0, 4.0, "where the ball will be then"),
    Part("meeting_ball_vel", 3, "m/s", -40.0, 40.0, "its velocity then"),
)
"""Option ``prediction``: all samples since the launch taken together (``prediction.py``), latency made up for."""

AGE: tuple[Part, ...] = (Part("sample_age", 1, "s", 0.0, 2.5, "how long ago the ball was where it is seen"),)
"""Option ``age``: latency and lost samples are known to whoever stamps his samples."""

EARLIER: tuple[Part, ...] = (
    Part("earlier_ball_pos", 3, "m", -4.0, 4.0, "ball as perceived some control steps ago"),
    Part("earlier_ball_vel", 3, "m/s", -40.0, 40.0, "its velocity as perceived then"),
)
"""Option ``history``: one of these for each earlier control step, newest first. A memory shows drag and spin."""

PRIVILEGED: tuple[Part, ...] = (
    Part("true_ball_pos", 3, "m", -4.0, 4.0, "where the ball is, now"),
    Part("true_ball_vel", 3, "m/s", -40.0, 40.0, "its velocity"),
    Part("true_ball_spin", 3, "rad/s", -1500.0, 1500.0, "its spin"),
    Part("drag_lift", 2, "-", 0.0, 2.0, "factors of the air in this rally"),
    Part("table", 2, "-", 0.0, 1.0, "restitution and friction of the table in this rally"),
    Part(
        "rubber",
        4,
        "-, s/m",
        0.0,
        1.0,
        "restitution, its slope, alpha and spin loss of the racket in this rally",
    ),
)
"""What the critic may see besides, in training: the simulator's truth. The policy never does."""

ACTION: tuple[Part, ...] = (
    Part("joint_target", 7, "half-range", -1.0, 1.0, "each joint's absolute target: middle + a x half-range"),
)


JOINT_RANGES: Final = (
    # name, unit, half-range: targets reach from -half-range to half-range; home
    ("rail_x", "m", 0.75, 0.0),
    ("rail_y", "m", 0.90, 0.0),
    ("yaw", "rad", 2.9, 0.0),
    ("pitch", "rad", 1.75, 1.0),
    ("elbow", "rad", 2.4, 1.0),
    ("wrist", "rad", 2.1, 1.1),
    ("roll", "rad", 2.9, 0.0),
)
"""The robot's joints in the order of observation and action, as ``common/env/robot.xml`` has them."""


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


class ObservationConfig(BaseModel):
    """What policy and critic see; the paper's is 37 numbers for both."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    history: int = Field(
        0, ge=0, le=32, description="earlier ball samples that the policy sees, one a control step"
    )
    ball: Literal["sampled", "filtered"] = Field(
        "sampled",
        description="the ball's position and velocity among the paper's 37: its newest sample, late and noisy, or, "
        "until it is hit, what all samples together say of where it is now",
    )
    spin: Literal["hidden", "estimated", "true"] = Field(
        "estimated",
        description="the ball's spin as the policy is told it: not at all, as its flight tells (prediction.py), or "
        "the truth: a ceiling, nothing for a robot",
    )
    spin_expected: Expectation = Field(
        "mild",
        description="how fast balls are expected to spin, for lift saturates and hides it: to 100 rad/s, half of "
        "them to 300, all of them to 300, or as the other side's earlier balls did (learnt: to play with, where an "
        "environment's balls come from one side; not on launch preset mixed)",
    )
    prediction: bool = Field(
        True,
        description="tell the policy where the ball is now and how it will come to be met, from all its samples "
        "(prediction.py)",
    )
    age: bool = Field(
        True, description="tell the policy how old its ball sample is: samples carry a time stamp"
    )
    critic: Literal["policy", "privileged"] = Field(
        "privileged",
        description="what the critic sees: what the policy does, or the simulator's truth besides",
    )

    @property
    def is_tracked(self) -> bool:
        """Whether a policy sees anything that is made of all samples since the launch."""
        return self.ball == "filtered" or self.spin == "estimated" or self.prediction


PAPER_OBSERVATION = ObservationConfig(history=0, spin="hidden", prediction=False, age=False, critic="policy")
"""The paper's: 37 numbers for policy and critic alike."""


def policy_layout(config: ObservationConfig) -> tuple[Part, ...]:
    """Return what the policy sees."""
    earlier = tuple(
        part._replace(name=f"{part.name}_{k}") for k in range(1, config.history + 1) for part in EARLIER
    )
    spin = {"hidden": (), "estimated": SPIN_ESTIMATE, "true": SPIN}[config.spin]
    paper = tuple(
        part._replace(meaning=_FILTERED[part.name])
        if config.ball == "filtered" and part.name in _FILTERED
        else part
        for part in OBSERVATION
    )
    return paper + spin + (PREDICTION if config.prediction else ()) + (AGE if config.age else ()) + earlier


def critic_layout(config: ObservationConfig) -> tuple[Part, ...]:
    """Return what the critic sees: the policy's numbers first."""
    return policy_layout(config) + (PRIVILEGED if config.critic == "privileged" else ())


ACTION_SIZE = size(ACTION)


def _index(where: slice) -> str:
    return f"{where.start}-{where.stop - 1}" if where.stop - where.start > 1 else str(where.start)


def markdown() -> str:
    """Return both layouts as the text of docs/observation.md."""
    lines = [
        "# Observation and action",
        "",
        "World frame: origin at the centre of the table top, x from the robot to the opponent, y to the robot's left,",
        "z up. Racket frame: x the face's normal, towards the opponent at home; z towards the handle.",
        "tau_01 coming, tau_12 bounced on the robot's court, tau_23 hit, tau_30 landed.",
        "Generated: `python -m common.rally.observation > docs/observation.md`.",
        "",
        f"## What policies see by default: {size(policy_layout(ObservationConfig()))} numbers",
        "",
        "| index | name |",
        "|---|---|",
    ]
    for name, where in offsets(policy_layout(ObservationConfig())).items():
        lines.append(f"| {_index(where)} | {name} |")
    lines += [
        "",
        "The first 37 are the paper's; the others are options, each explained below. A policy's contract.json names",
        "its own. All are raw numbers: the normaliser comes with the policy. With option ball filtered, 24-29 are",
        "present_ball_pos and present_ball_vel.",
    ]
    tables = (
        ("The paper's", OBSERVATION),
        ("Option spin estimated, after it", SPIN_ESTIMATE),
        ("Option spin true, in its place", SPIN),
        ("Option prediction, after that", PREDICTION),
        ("Option age, after that", AGE),
        ("Option history, after that, each", EARLIER),
        ("What the critic alone sees, last", PRIVILEGED),
        ("Action", ACTION),
    )
    for title, layout in tables:
        lines += [
            "",
            f"## {title}: {size(layout)} number{'s' if size(layout) > 1 else ''}",
            "",
            "| index | name | unit | range | is |",
            "|---|---|---|---|---|",
        ]
        for name, where in offsets(layout).items():
            part = next(part for part in layout if part.name == name)
            numbers = f"{part.low:g} to {part.high:g}"
            lines.append(f"| {_index(where)} | {name} | {part.unit} | {numbers} | {part.meaning} |")
    lines += [
        "",
        "Targets beyond -1 to 1 are clipped. Gains and force limits stand in `common/env/robot.xml`.",
        "",
        "| joint | half-range | home |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {half_range:g} {unit} | {home:g} |" for name, unit, half_range, home in JOINT_RANGES
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(markdown())
