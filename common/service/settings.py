"""Settings that every service has: its run, its name, the hub's address, the address of its metrics."""

import os
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.comms.zenoh_config import LinkConfig, ZenohConfig
from common.service.endpoint import FIRST_PORT
from common.service.run_folder import LATEST, newest_run

MOST_ACTORS: Final = 1000
LOCAL_ACTORS: Final = 2  # of a run on one machine: they play about what one learner trains
FROM_LEARNER: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "": ("seed", "actors", "generators", "shards", "lease_s", "max_message_mib"),
        "task": (),
        "network": (),
        "experience": (),
        "actor": ("envs", "horizon", "rallies"),
    }
)
"""Settings that a learner gives to actors that join: by table ("": none), and of which table all (). No other counts:
on an open hub a stranger may answer, and must not say where files are written or where the actor connects."""
LogLevel = Literal["debug", "info", "warning", "error"]


class RunSettings(LinkConfig):
    """Settings that are the same for all services of a run."""

    run: str = Field("default", description="run that the service belongs to; part of every key")
    seed: int = Field(0, ge=0, lt=2**63, description="seed of all random numbers of the run")
    metrics_host: str = Field(
        "127.0.0.1", description="address that /metrics, /healthz and /readyz are served on"
    )
    log_level: LogLevel = Field("info", description="lowest level that is logged")
    status_interval_s: float = Field(
        1.0, gt=0, le=60, description="time between heartbeats", json_schema_extra={"unit": "s"}
    )


class ServiceConfig(RunSettings, ZenohConfig):
    """Settings of one service's process."""

    id: str = Field("0", exclude=True, description="name of this service among those of its role")
    metrics_port: int = Field(
        FIRST_PORT,
        ge=0,
        le=65535,
        exclude=True,
        description="HTTP port of /metrics, or the next free one; 0: any free one",
    )

    @model_validator(mode="after")
    def _the_run_is_named(self) -> Self:
        if self.run == LATEST:  # keys have the run's own name, and the newest run may be another one soon
            raise ValueError(f"run {LATEST!r}, which is now {newest_run()!r}; allowed: a run's own name")
        return self


class Fleet(BaseModel):
    """How many services a run has."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    actors: int = Field(
        1,
        ge=1,
        le=MOST_ACTORS,
        description="actors of the run: a dataset is one rollout of each, and they share 256 environments",
    )
    generators: int = Field(1, ge=1, le=100, description="generators of the run")
    shards: int = Field(0, ge=0, le=4096, description="streams of rallies; 0: one for each actor")

    @property
    def shard_count(self) -> int:
        """Number of streams of rallies."""
        return self.shards or self.actors


def new_incarnation() -> int:
    """Return a number that is larger in every later life of a service, unless its host's clock was set back.

    It is milliseconds since 1970, then the process id.
    """
    return int(time.time() * 1000) * 2**10 + os.getpid() % 2**10


def from_learner(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return of a run's settings those that a learner gives to actors that join."""
    found: dict[str, Any] = {name: tables[name] for name in FROM_LEARNER[""] if name in tables}
    for table, names in FROM_LEARNER.items():
        values = tables.get(table)
        if isinstance(values, dict):
            some = {name: value for name, value in values.items() if not names or name in names}
            found |= {table: some} if some else {}
    return found
