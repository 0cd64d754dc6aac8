"""What an exported policy expects from a robot and sends to it: ``contract.json`` of an exported folder."""

import hashlib
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import ReportedError
from common.physics.chain import JOINTS, Chain
from common.task.observation import ACTION_SIZE, ObservationConfig, policy_layout

Array = npt.NDArray[np.float64]

CONTRACT_FILE, POLICY_FILE = "contract.json", "policy.onnx"
FORMAT: Final = "topspin-robot 1"
FRAME: Final = (
    "origin at the centre of the table top, x from the robot to the opponent, y to the robot's left, z up"
)


class ExportError(ReportedError, ValueError):
    """An exported folder that can't be used: one line with what was found and what is allowed."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Numbers(_Table):
    """A contiguous part of the observation or the action, in its order."""

    name: str
    size: int = Field(ge=1)
    unit: str
    low: float
    high: float
    meaning: str


class Joint(_Table):
    """One joint. Its target is middle + action x half_range. Units: m, m/s, N (slide), or rad, rad/s, Nm (hinge)."""

    name: str
    kind: Literal["slide", "hinge"]
    middle: float
    half_range: float = Field(gt=0)
    home: float
    speed: float = Field(gt=0, description="speed limit of the simulated drive")
    force: float = Field(gt=0, description="largest force or torque of the simulated drive")
    kp: float = Field(gt=0, description="force for an error of the position")
    kv: float = Field(ge=0, description="force for a speed")


class Kinematics(_Table):
    """The robot's chain, which gives the racket's pose: fields and columns of ``common/physics/chain.py``."""

    joints: tuple[tuple[float, ...], ...] = Field(min_length=JOINTS, max_length=JOINTS)
    capsules: tuple[tuple[float, ...], ...]
    racket: tuple[float, ...] = Field(min_length=14, max_length=14)
    slides: int
    hub: tuple[float, float, float]
    hub_reach: float

    @classmethod
    def of(cls, chain: Chain) -> Self:
        """Return a chain as data."""
        return cls(
            joints=tuple(map(tuple, chain.joints.tolist())),
            capsules=tuple(map(tuple, chain.capsules.tolist())),
            racket=tuple(chain.racket.tolist()),
            slides=chain.slides,
            hub=chain.hub,
            hub_reach=chain.hub_reach,
        )

    def chain(self) -> Chain:
        """Return the chain as the kernels take it."""
        return Chain(
            joints=np.array(self.joints, np.float64).reshape(JOINTS, JOINTS),
            capsules=np.array(self.capsules, np.float64).reshape(-1, 8),
            racket=np.array(self.racket, np.float64),
            slides=self.slides,
            hub=self.hub,
            hub_reach=self.hub_reach,
        )


class Filters(_Table):
    """Settings of the filters. Put in the noise of your own camera."""

    camera_noise: float = Field(gt=0, le=0.1, description="deviation of a detection an axis [m]")
    position_noise: float = Field(
        ge=0, le=0.1, description="deviation of a ball sample's position an axis [m]"
    )
    velocity_noise: float = Field(
        ge=0, le=2, description="deviation of a ball sample's velocity an axis [m/s]"
    )
    observed_ago: float = Field(
        ge=0,
        le=0.2,
        description="age of the camera filter's estimate that the policy observes as measured [s]",
    )


class RobotContract(_Table):
    """All that a robot's program must know of a policy."""

    format: Literal["topspin-robot 1"] = FORMAT
    policy: str
    policy_sha256: str = Field(description="of policy.onnx")
    robot: str
    control_rate_hz: float = Field(gt=0)
    frame: str = FRAME
    observation: tuple[Numbers, ...]
    action: tuple[Numbers, ...]
    options: ObservationConfig
    joints: tuple[Joint, ...] = Field(min_length=JOINTS, max_length=JOINTS)
    kinematics: Kinematics
    filters: Filters
    trained: dict[str, Any] = Field(description="conditions of the training")
    measures: dict[str, Any] = Field(description="what `topspin evaluate` found, by exam")
    made_with: dict[str, str]

    @model_validator(mode="after")
    def _layouts_are_this_versions(self) -> Self:
        found = [(part.name, part.size, part.unit) for part in self.observation]
        if found != [(part.name, part.size, part.unit) for part in policy_layout(self.options)]:
            raise ValueError("observation is not the layout of its options in this version of topspin-robot")
        if [part.size for part in self.action] != [ACTION_SIZE]:
            raise ValueError(
                f"action has {[part.size for part in self.action]} numbers; allowed: {[ACTION_SIZE]}"
            )
        return self

    @property
    def size(self) -> int:
        """How many numbers the policy observes."""
        return sum(part.size for part in self.observation)

    @property
    def period(self) -> float:
        """Time between control steps [s]."""
        return 1.0 / self.control_rate_hz

    @property
    def joint_names(self) -> list[str]:
        """The joints' names, from the robot's base to its racket."""
        return [joint.name for joint in self.joints]

    def of_joints(self, field: Literal["middle", "half_range", "home", "speed", "force"]) -> Array:
        """Return one field of all joints (7,)."""
        return np.array([getattr(joint, field) for joint in self.joints], np.float64)

    def range_of(self, name: str) -> tuple[float, float]:
        """Return the range of a part of the observation."""
        part = next(part for part in self.observation if part.name == name)
        return part.low, part.high


def sha256_of(file: Path) -> str:
    """Return a file's SHA-256 in hexadecimal."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def read_contract(folder: Path) -> RobotContract:
    """Return the contract of an exported folder.

    Raises:
        ExportError: A file is missing or wrong, or the network is of another export.
    """
    path = folder / CONTRACT_FILE
    try:
        contract = RobotContract.model_validate_json(path.read_bytes())
        found = sha256_of(folder / POLICY_FILE)
    except OSError as error:
        raise ExportError(
            f"no exported policy in {folder}: {error.strerror} ({Path(error.filename or '').name}); "
            "allowed: a folder of `topspin export`"
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "file"
        raise ExportError(f"{path}: {where}: {first['msg']}") from None
    if found != contract.policy_sha256:
        raise ExportError(
            f"{folder / POLICY_FILE} has SHA-256 {found[:12]}...; its contract allows {contract.policy_sha256[:12]}..."
        )
    return contract
