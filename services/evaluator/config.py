"""Settings of the evaluator."""

from typing import Literal

from pydantic import Field

from common.env.rally_env import EnvConfig
from common.policy.actor_critic import NetworkConfig
from common.rally.launch_presets import PresetName
from common.service_config import ServiceConfig
from services.evaluator.match import DEFAULT_ENVS, Environments, PolicyExpectation


class EvaluatorConfig(ServiceConfig):
    """Settings of the evaluator. With --policy: play once, print, end. Without: follow a run and keep its best.

    Commands with settings of their own, in the place of flags: `play`, `pictures`, `real2sim`, `report RUN...`, `ship`.
    """

    policy: str = Field("", description="policy folder to play once; empty: follow the run")
    rallies: int = Field(
        1000, ge=1, le=1_000_000, description="rallies to play; in following, of each evaluation"
    )
    launch: PresetName = Field("paper", description="launch preset")
    noise: Literal["off", "standard", "hard"] = Field("standard", description="noise profile")
    rounds: int = Field(1, ge=1, le=1000, description="rallies an episode plays while they are returned")
    envs: Environments = DEFAULT_ENVS
    spin_expected: PolicyExpectation = "contract"
    json_line: bool = Field(
        False, alias="json", description="print the measures as one JSON object, last line"
    )
    env: EnvConfig = EnvConfig()
    network: NetworkConfig = NetworkConfig()
    folder: str = Field("", description="run folder; empty: runs/RUN")
    interval_s: float = Field(
        45.0, gt=0, description="following: time between evaluations", json_schema_extra={"unit": "s"}
    )
    niceness: int = Field(10, ge=0, le=19, description="following: lets learner and actors go first")
