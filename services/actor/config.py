"""Settings of an actor."""

from typing import Literal

from pydantic import Field

from common.env.rally_env import EnvConfig
from common.policy.actor_critic import NetworkConfig
from common.rally.launch_presets import PresetName
from common.service_config import ServiceConfig
from services.actor.outbox import OutboxConfig


class ActorConfig(ServiceConfig):
    """Settings of an actor; task and network must be the learner's, or its rollouts are refused."""

    env: EnvConfig = EnvConfig()
    network: NetworkConfig = NetworkConfig()
    outbox: OutboxConfig = OutboxConfig()
    launch: PresetName = Field("paper", description="launch preset, as the generators'")
    envs: int = Field(256, ge=1, le=65536, description="environments played together")
    horizon: int = Field(32, ge=1, le=4096, description="control steps of one rollout")
    index: int = Field(
        0, ge=0, description="number of this actor; decides its action noise and its rally shard"
    )
    shards: int = Field(
        1, ge=1, le=4096, description="rally shards in all; this actor takes index mod shards"
    )
    rallies: Literal["subscribe", "ask"] = Field(
        "subscribe",
        description="take the rallies that are published, or ask for each block by index and wait for it "
        "(reproducible bit for bit)",
    )
    rally_wait_s: float = Field(
        10.0, gt=0, description="wait for a block that was asked for", json_schema_extra={"unit": "s"}
    )
    silence_warning_s: float = Field(
        10.0,
        gt=0,
        description="idle time after which the log says who is waited for",
        json_schema_extra={"unit": "s"},
    )
