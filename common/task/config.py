"""The task's settings, said once. A policy's contract holds them, and a hash of them keeps learner and actors alike."""

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import ConfigError
from common.physics.constants import GRID_STEP
from common.physics.flight_model import Flight
from common.task.observation import ObservationConfig

PresetName = Literal["paper", "strong", "mixed", "match", "elite", "serve", "all"]
RobotName = Literal["rails", "usst", "pro", "arm"]  # the folders of common/robot/robots
RubberName = Literal["inverted", "short_pips", "medium_pips", "long_pips", "long_pips_ox", "anti_spin"]
FlightName = Literal["simple", "full"]
Randomization = Literal["off", "standard", "hard"]
Perception = Literal["cheap", "full"]


class PlayConditions(BaseModel):
    """Conditions under which a policy plays. They may differ from those of its training."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    randomization: Randomization = Field(
        "standard",
        description="how much air, table, rubber, drives, latency and noise differ from rally to rally",
    )
    perception: Perception = Field(
        "cheap",
        description="what the robot measures of the ball: cheap: its true state, late and noisy; full: the estimate of "
        "the camera filter, from the detections of a simulated camera",
    )
    flight: FlightName = Field(
        "full",
        description="aerodynamics of the ball: full: coefficients that depend on speed and spin; simple: constant "
        "drag, and lift that is linear in spin up to a limit",
    )


class MatchConditions(PlayConditions):
    """Conditions of a match against balls from a launch preset."""

    launch: PresetName = Field(
        "paper",
        description="balls: paper: mild ones; strong: to 300 rad/s; mixed: half of each; match: strokes of elite "
        "players; elite: the hardest of these (15-20 m/s, over 600 rad/s); serve; all: every kind, and in training "
        "each the more often, the more often it is lost",
    )
    rounds: int = Field(
        1,
        ge=1,
        le=1000,
        description="most rallies of an episode; it continues while the robot returns the ball",
    )
    collision: Literal["tailored", "original"] = Field(
        "tailored",
        description="contacts of the ball: tailored: ours, exact in time, with measured laws; original: MuJoCo's own, "
        "half as fast",
    )
    time_limit_s: float = Field(
        2.5,
        gt=0.1,
        le=60,
        description="longest rally; a longer one is truncated",
        json_schema_extra={"unit": "s"},
    )


class RewardConfig(BaseModel):
    """The reward's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reference_rate_hz: float = Field(
        50.0,
        gt=0,
        le=1000,
        description="control rate at which the rewards of continuing states, torque and collision are not scaled",
        json_schema_extra={"unit": "Hz"},
    )
    torque: float = Field(
        0.02, ge=0, le=10, description="c: weight of sum |T_i|/T_max,i", json_schema_extra={"unit": "-"}
    )
    jitter: float = Field(
        0.02, ge=0, le=10, description="d: weight of sum (a(t) - a(t-1))^2", json_schema_extra={"unit": "-"}
    )
    collision: float = Field(
        10.0,
        ge=0,
        le=100,
        description="e: weight of sum min(F_c/50 N, 1) over the links: contacts with table, floor, net, robot",
        json_schema_extra={"unit": "-"},
    )
    landing_scale: float = Field(
        0.5,
        gt=0,
        le=10,
        description="length scale s of the landing reward; 1 m in the paper",
        json_schema_extra={"unit": "m"},
    )
    landing_bonus: float = Field(
        100.0,
        ge=0,
        le=1000,
        description="weight w of stage 3's bonus right after the contact: w/(1 + (e/s)^2), e the distance from the "
        "predicted landing point to the target; half of it if the ball will not clear the net; 0 in the paper",
        json_schema_extra={"unit": "-"},
    )
    landing_bonus_scale: float = Field(
        0.5, gt=0, le=10, description="length scale s of the landing bonus", json_schema_extra={"unit": "m"}
    )


PAPER_REWARD = RewardConfig(reference_rate_hz=200.0, collision=0.1, landing_scale=1.0, landing_bonus=0.0)
"""The paper's reward at its 200 Hz: R as printed and e_r, without landing bonus. The default differs in all four."""


class TaskConfig(MatchConditions):
    """What the task is: robot, control rate, balls, randomization, perception, rules, observation and reward."""

    robot: RobotName = Field(
        "rails",
        description="rails: two rails and five joints; usst: the same with the published joint speeds of the authors' "
        "robot; pro: the same with much stronger drives; arm: a seven-joint arm on a fixed base",
    )
    rubber: RubberName = Field(
        "inverted",
        description="covering of the racket, a published one; the randomization's ranges are scaled to it; only with "
        "collision tailored",
    )
    control_rate_hz: Literal[25, 50, 100, 200] = Field(
        50, description="control steps a second", json_schema_extra={"unit": "Hz"}
    )
    carry_over: float = Field(
        0.5,
        ge=0,
        le=1,
        description="share of episodes in which the robot starts where the last stroke left it, if that was played to "
        "its end",
    )
    reset_spread: float = Field(
        0.1,
        ge=0,
        le=0.5,
        description="in the other episodes each joint starts at home, plus or minus up to this",
        json_schema_extra={"unit": "m, rad"},
    )
    reward: RewardConfig = RewardConfig()
    observation: ObservationConfig = ObservationConfig()

    @model_validator(mode="after")
    def _contacts_know_the_rubber(self) -> Self:
        if self.collision == "original" and self.rubber != "inverted":
            raise ValueError(
                f"rubber {self.rubber} with collision original; MuJoCo's own contacts know no rubber, "
                "allowed: collision tailored"
            )
        return self

    @property
    def flight_model(self) -> Flight:
        """The aerodynamics as the kernels name them."""
        return Flight[self.flight.upper()]

    @property
    def grid_steps(self) -> int:
        """Steps of the flight's grid in one control step."""
        return round(1.0 / (self.control_rate_hz * GRID_STEP))

    def under(self, conditions: PlayConditions) -> "TaskConfig":
        """Return the task with all settings of ``conditions``; every other setting stays.

        Raises:
            ConfigError: There is no such task, such as this one's rubber with MuJoCo's contacts.
        """
        names = type(conditions).model_fields.keys() & MatchConditions.model_fields.keys()
        try:
            return type(self).model_validate(
                self.model_dump() | {name: getattr(conditions, name) for name in names}
            )
        except ValidationError as error:
            raise ConfigError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
