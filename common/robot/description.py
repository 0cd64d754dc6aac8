"""A robot's description: ``robots/NAME/robot.toml``, beside its MJCF model."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import ReportedError
from common.physics.chain import JOINTS

ROBOTS: Final = Path(__file__).with_name("robots")
"""One folder a robot: ``robot.toml``, and ``robot.xml`` unless the table names another robot's."""


class RobotError(ReportedError):
    """A robot's files are missing or wrong."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class JointDrive(_Table):
    """One joint with its drive. Units: m, m/s, N for a slide; rad, rad/s, Nm for a hinge."""

    name: str
    range: tuple[float, float] = Field(description="targets that actions -1 and 1 stand for")
    home: float = Field(description="position at rest")
    speed: float = Field(gt=0, description="speed limit: without load the drive gets no faster")
    force: float = Field(gt=0, description="largest force or torque of the drive")
    kp: float = Field(gt=0, description="force for an error of the position")
    kv: float = Field(ge=0, description="force for a speed")

    @model_validator(mode="after")
    def _home_is_in_range(self) -> "JointDrive":
        low, high = self.range
        if not low < high:
            raise ValueError(f"range {list(self.range)}; allowed: the lower end first")
        if not low <= self.home <= high:
            raise ValueError(f"home {self.home:g}; allowed: {low:g} to {high:g}, its range")
        return self


class RobotDescription(_Table):
    """What a robot's MJCF model does not say."""

    summary: str = Field(description="one line for the reference")
    model: str = Field("", description="the robot whose MJCF this one uses; empty: its own")
    racket: str = Field("racket", description="the racket's cylinder geom; a site of this name has its frame")
    links: tuple[str, ...] = Field(description="geoms that can strike something, in the order of the sensors")
    self_contacts: tuple[tuple[str, str], ...] = Field(description="pairs of the robot's geoms that can meet")
    cover_s: float = Field(
        0.012,
        ge=0.008,  # MuJoCo needs two of its steps
        le=0.1,
        description="time constant of the covers where they meet: shorter is stiffer",
        json_schema_extra={"unit": "s"},
    )
    joint: tuple[JointDrive, ...] = Field(description="from the base to the racket")

    @model_validator(mode="after")
    def _has_seven_joints(self) -> "RobotDescription":
        if len(self.joint) != JOINTS:
            raise ValueError(f"{len(self.joint)} joints; allowed: {JOINTS}")
        return self


def robot_names() -> list[str]:
    """Return the names of all robots."""
    return sorted(path.parent.name for path in ROBOTS.glob("*/robot.toml"))


@cache
def describe(name: str) -> RobotDescription:
    """Return the description of a robot.

    Raises:
        RobotError: There is no such robot, or its table is wrong.
    """
    path = ROBOTS / name / "robot.toml"
    if name not in robot_names():
        raise RobotError(f"robot {name!r}; allowed: {', '.join(robot_names())}")
    try:
        return RobotDescription.model_validate(tomllib.loads(path.read_text()))
    except tomllib.TOMLDecodeError as error:
        raise RobotError(f"{path}: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "table"
        raise RobotError(f"{path}: {where}: {first['msg']}") from None


def model_path(name: str) -> Path:
    """Return a robot's MJCF file."""
    return ROBOTS / (describe(name).model or name) / "robot.xml"
