"""What every service is told: its run, its name, where the hub is, where its metrics are served."""

import os
import time
from typing import Literal

from pydantic import Field

from common.comms.zenoh_config import ZenohConfig


class ServiceConfig(ZenohConfig):
    """Settings shared by all services, the way to the hub among them."""

    run: str = Field("default", description="run this service belongs to; part of every key")
    id: str = Field("0", description="name of this service among those of its role")
    metrics_port: int = Field(0, ge=0, le=65535, description="HTTP port of /metrics; 0 takes any free one")
    metrics_host: str = Field("127.0.0.1", description="address that /metrics is served on")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severe lines logged"
    )
    status_interval_s: float = Field(
        1.0, gt=0, le=60, description="time between heartbeats", json_schema_extra={"unit": "s"}
    )
    seed: int = Field(
        0, ge=0, lt=2**63, description="of everything random in the run; the same at every service"
    )


def new_incarnation() -> int:
    """Return a number that is larger in every later life of a service: milliseconds since 1970, then the process id."""
    return int(time.time() * 1000) * 2**10 + os.getpid() % 2**10
