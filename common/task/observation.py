"""Observation and action: name, unit, range and meaning of each number, and the settings of the observation."""

from typing import Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

ExpectedSpin = Literal["mild", "mixed", "strong", "learnt"]  # keys of ``flight_track.SPIN_PRIORS``


class Part(NamedTuple):
    """A contiguous part of a vector."""

    name: str
    size: int
    unit: str
    low: float  # smallest value that play can produce; the normalizer clips what lies far beyond the range
    high: float
    meaning: str


OBSERVATION: tuple[Part, ...] = (
    Part("joint_pos", 7, "m, rad", -3.2, 3.2, "positions of the robot's joints, from its base to the racket"),
    Part("joint_vel", 7, "m/s, rad/s", -60.0, 60.0, "velocities of the same joints"),
    Part("racket_pos", 3, "m", -3.0, 2.0, "position of the racket's centre"),
    Part(
        "racket_quat",
        4,
        "-",
        -1.0,
        1.0,
        "quaternion (w, x, y, z) of the racket, w >= 0; near (1, 0, 0, 0) at home",
    ),
    Part("racket_vel", 3, "m/s", -30.0, 30.0, "velocity of the racket's centre"),
    Part(
        "ball_pos",
        3,
        "m",
        -4.0,
        4.0,
        "measured position of the ball: late, noisy, sometimes the last one again",
    ),
    Part("ball_vel", 3, "m/s", -40.0, 40.0, "measured velocity of the ball"),
    Part("target", 2, "m", -0.7425, 1.35, "x and y of the target on the opponent's court"),
    Part(
        "trajectory_state", 1, "-", -1.0, 1.0, "2s/3 - 1, where s is 0 launched, 1 bounced, 2 hit, 3 landed"
    ),
    Part(
        "continuous_state",
        4,
        "-",
        0.0,
        1.0,
        "one-hot over tau_01, tau_12, tau_23, tau_30; all 0: a serve before its first bounce",
    ),
)
"""The paper's observation, in its order. The paper prints "racket position (7)"; only 3 gives the sum of 37."""

_FILTERED: Final = {
    "ball_pos": "estimated position of the ball now; after the hit the measured one",
    "ball_vel": "estimated velocity of the ball now; after the hit the measured one",
}
"""Option ``ball: filtered``: meaning of these parts."""

SPIN: tuple[Part, ...] = (
    Part("ball_spin", 3, "rad/s", -1500.0, 1500.0, "true spin of the ball; a robot cannot measure it"),
)
"""Option ``spin: true``: an upper bound for comparison."""

SPIN_ESTIMATE: tuple[Part, ...] = (
    Part("spin_estimate", 3, "rad/s", -1500.0, 1500.0, "estimated spin of the ball after the bounce"),
)
"""Option ``spin: estimated``: the flight filter's estimate, which a robot can compute."""

PREDICTION: tuple[Part, ...] = (
    Part("present_ball_pos", 3, "m", -4.0, 4.0, "estimated position of the ball now"),
    Part("present_ball_vel", 3, "m/s", -40.0, 40.0, "estimated velocity of the ball now"),
    Part(
        "interception_in",
        1,
        "s",
        -2.5,
        1.2,
        "time until the interception: 0.12 s after the bounce",
    ),
    Part("interception_ball_pos", 3, "m", -8.0, 4.0, "predicted position of the ball at the interception"),
    Part(
        "interception_ball_vel", 3, "m/s", -40.0, 40.0, "predicted velocity of the ball at the interception"
    ),
)
"""Option ``prediction``: from all samples since the launch (``flight_filter``). It compensates the latency."""

AGE: tuple[Part, ...] = (Part("sample_age", 1, "s", 0.0, 2.5, "age of the measured position and velocity"),)
"""Option ``age``: a robot that stamps its samples knows latency and lost samples."""

EARLIER: tuple[Part, ...] = (
    Part("earlier_ball_pos", 3, "m", -4.0, 4.0, "measured position of the ball in an earlier control step"),
    Part(
        "earlier_ball_vel", 3, "m/s", -40.0, 40.0, "measured velocity of the ball in an earlier control step"
    ),
)
"""Option ``history``: one of these for each earlier control step, newest first. They show drag and spin."""

PRIVILEGED: tuple[Part, ...] = (
    Part("true_ball_pos", 3, "m", -4.0, 4.0, "true position of the ball now"),
    Part("true_ball_vel", 3, "m/s", -40.0, 40.0, "true velocity of the ball now"),
    Part("true_ball_spin", 3, "rad/s", -1500.0, 1500.0, "true spin of the ball now"),
    Part("drag_lift", 2, "-", 0.0, 2.0, "drag factor and lift factor of the rally"),
    Part("table", 2, "-", 0.0, 1.0, "restitution and friction of the table in the rally"),
    Part(
        "rubber",
        4,
        "-, s/m",
        0.0,
        1.0,
        "restitution, its slope, alpha and spin loss of the racket in the rally",
    ),
)
"""The simulator's truth, which the critic may observe in training. The policy never observes it (ADR-0009)."""

ACTION: tuple[Part, ...] = (
    Part(
        "joint_target", 7, "half-range", -1.0, 1.0, "absolute target of each joint: middle + a x half-range"
    ),
)


def size(layout: tuple[Part, ...]) -> int:
    """Return how many numbers a layout has."""
    return sum(part.size for part in layout)


def offsets(layout: tuple[Part, ...]) -> dict[str, slice]:
    """Return the slice of each part by its name."""
    start, found = 0, {}
    for part in layout:
        found[part.name] = slice(start, start + part.size)
        start += part.size
    return found


class ObservationConfig(BaseModel):
    """What policy and critic observe. The paper's observation has 37 numbers for both."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    history: int = Field(
        0, ge=0, le=32, description="measurements of earlier control steps that the policy observes"
    )
    ball: Literal["sampled", "filtered"] = Field(
        "sampled",
        description="ball position and velocity among the paper's 37 numbers: sampled: the newest measurement, late "
        "and noisy; filtered: until the hit, the estimate for now from all measurements",
    )
    spin: Literal["hidden", "estimated", "true"] = Field(
        "estimated",
        description="the ball's spin that the policy observes: hidden: none; estimated: the flight filter's estimate; "
        "true: the true spin, an upper bound that no robot can measure",
    )
    expected_spin: ExpectedSpin = Field(
        "mild",
        description="how fast balls are expected to spin. The flight hides strong spin, because lift saturates. mild: "
        "to 100 rad/s; strong: to 300 rad/s, or as players hit them; mixed: half of them mild; learnt: as the "
        "opponent's earlier balls did, for play in which the balls of an environment come from one opponent after the "
        "other; not for matches with launch preset mixed",
    )
    prediction: bool = Field(
        True,
        description="observe the ball's estimated state now and at the interception, from all measurements "
        "(flight_filter.py)",
    )
    age: bool = Field(True, description="observe the age of the newest measurement; measurements are stamped")
    critic: Literal["policy", "privileged"] = Field(
        "privileged",
        description="what the critic observes: policy: the same as the policy; privileged: also the simulator's truth",
    )

    @property
    def is_tracked(self) -> bool:
        """Whether the policy observes a result of the flight filter."""
        return self.ball == "filtered" or self.spin == "estimated" or self.prediction


PAPER_OBSERVATION = ObservationConfig(history=0, spin="hidden", prediction=False, age=False, critic="policy")
"""The paper's observation: the same 37 numbers for policy and critic."""


def policy_layout(config: ObservationConfig) -> tuple[Part, ...]:
    """Return what the policy observes."""
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
    """Return what the critic observes: the policy's numbers first."""
    return policy_layout(config) + (PRIVILEGED if config.critic == "privileged" else ())


ACTION_SIZE = size(ACTION)
