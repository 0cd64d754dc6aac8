"""Settings of every command that plays a match."""

from typing import Annotated, Final, Literal

from pydantic import Field

from common.task.config import MatchConditions
from common.task.observation import ExpectedSpin

SEED: Final = 20260  # of the fixed rallies, unless another is set
DEFAULT_ENVS: Final = 250

Environments = Annotated[
    int,
    Field(
        ge=1,
        le=65536,
        description="environments played together; unless recordings name the players, each plays rallies / envs "
        "balls of the same opponent",
    ),
]
MatchSpin = Annotated[
    ExpectedSpin | Literal["contract"],
    Field(
        description="spin that the robot expects (task.observation.expected_spin): mild, mixed, strong or learnt; "
        "contract: as the policy's contract says"
    ),
]


class RalliesConfig(MatchConditions):
    """Fixed rallies, and the conditions under which they are played."""

    rallies: int = Field(2000, ge=1, le=1_000_000, description="rallies to play")
    seed: int = Field(SEED, ge=0, lt=2**63, description="seed of the rallies")
    expected_spin: MatchSpin = "contract"


class MatchConfig(RalliesConfig):
    """A match: fixed rallies, played in environments that share them."""

    envs: Environments = DEFAULT_ENVS
