"""`python -m deploy.router`: a Zenoh router between the services of a run, so that none of them is the hub.

The learner then is a client (`--mode client`): when it starts again, no other service loses its link.
"""

# ruff: noqa: PLC0415 - what the router runs on is imported after its flags are read: --help answers at once
import logging
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from threading import Event
from typing import ClassVar, Final, Literal, Self

from pydantic import Field, model_validator

from common.comms.zenoh_config import ZenohConfig
from common.service.config import load
from common.service.endpoint import FIRST_PORT
from common.service.log import set_up_logging
from common.service.process import DONE, run_service
from common.service.settings import LogLevel

log = logging.getLogger(__name__)

PROG: Final = "python -m deploy.router"
TURN_S: Final = 1.0


class RouterConfig(ZenohConfig):
    """Pass messages between the services of one or many runs; start the learner with --mode client.

    It has no state. Services connect again when it comes back.
    """

    often: ClassVar = {
        "Where it listens": ("endpoint", "metrics_host", "metrics_port"),
    }

    mode: Literal["hub"] = Field("hub", exclude=True, description="a router listens")
    run: str = Field("", description="label of its metrics: it may serve many runs")
    metrics_host: str = Field("127.0.0.1", description="address that /metrics and /healthz are served on")
    metrics_port: int = Field(
        FIRST_PORT, ge=0, le=65535, description="HTTP port of /metrics, or the next free one; 0: any free one"
    )
    log_level: LogLevel = Field("info", description="lowest level that is logged")

    @model_validator(mode="after")
    def _is_open(self) -> Self:
        if self.tls:
            raise ValueError(
                f"tls {self.tls}; allowed: none: with TLS the learner is the hub, since it has the rules"
            )
        return self


def main(argv: Sequence[str], stop: Event) -> int:
    """Pass messages on until ``stop`` is set; return the exit status."""
    config = load(RouterConfig, argv, prog=PROG, section="router")
    set_up_logging(config.log_level, "router")
    from common.comms.zenoh_transport import open_zenoh
    from common.service.metrics import Metrics

    with closing(Metrics("router", "0", config.run)) as metrics:
        port = metrics.serve(config.metrics_port, config.metrics_host)
        log.info("serving metrics url=http://%s:%d/metrics", config.metrics_host, port)
        with closing(open_zenoh(config, stop)) as transport:
            metrics.health.has_joined = True
            log.info("passing messages on endpoint=%s", config.endpoint)
            while not stop.is_set():
                metrics.health.turn()
                metrics.set("topspin_heartbeat_time_seconds", time.time())
                transport.wait(TURN_S)
            log.info("stopped")
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, lambda stop: main(sys.argv[1:], stop)))
