"""The settings of `topspin view`."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from common.evaluation.config import SEED, MatchSpin
from common.service.settings import LogLevel
from common.task.config import PlayConditions, PresetName, RobotName


class ViewConfig(PlayConditions):
    """Show a policy at play: a live page in 3-D for your browser.

    Balls, robot, policy, camera and speed can be changed on the page. Control rate and observation are those of the
    policy's contract.
    """

    often: ClassVar = {
        "What plays": ("policy", "run"),
        "At first": ("launch", "robot", "randomization", "slow"),
        "The page": ("host", "port"),
    }

    policy: str = Field("", description="a policy of the box, or a policy folder; empty: default")
    run: str = Field(
        "", description="a run in runs/, running or not: its newest policy plays, and the page has its curves"
    )
    launch: PresetName = Field("paper", description="balls at first: a launch preset")
    robot: RobotName | Literal["contract"] = Field(
        "contract", description="robot at first; contract: the one that the policy was trained on"
    )
    slow: float = Field(
        1.0, ge=0.05, le=1, description="speed at first; 0.25 is four times slower than real time"
    )
    collision: Literal["tailored", "original"] = Field(
        "tailored", description="contacts of the ball: tailored: ours; original: MuJoCo's own"
    )
    expected_spin: MatchSpin = "contract"
    host: str = Field(
        "127.0.0.1",
        description="address to listen at; the page has no password, so another address shows it to the network",
    )
    port: int = Field(8300, ge=0, le=65535, description="port to listen at; 0: any free one")
    rate_hz: float = Field(
        50.0, ge=5, le=60, description="pictures per second", json_schema_extra={"unit": "Hz"}
    )
    seed: int = Field(SEED, ge=0, lt=2**63, description="seed of the balls")
    log_level: LogLevel = Field("warning", description="least severe lines logged")

    @model_validator(mode="after")
    def _one_policy(self) -> Self:
        if self.policy and self.run:
            raise ValueError(f"--policy {self.policy} with --run {self.run}; allowed: one of them")
        return self
