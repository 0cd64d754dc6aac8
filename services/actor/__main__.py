"""Run an actor: `python -m services.actor`."""

import sys
from threading import Event

from common.comms.zenoh_transport import open_zenoh
from common.config import load
from common.log import set_up_logging
from common.metrics import Metrics
from common.process import DONE, run_service
from common.service_config import new_incarnation
from services.actor.config import ActorConfig
from services.actor.service import ActorService

PROG = "python -m services.actor"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(ActorConfig, sys.argv[1:], prog=PROG, section="actor")
    set_up_logging(config.log_level, f"actor/{config.id}")
    metrics = Metrics("actor", config.id)
    metrics.serve(config.metrics_port, config.metrics_host)
    try:
        transport = open_zenoh(config, stop)
        try:
            ActorService(config, transport, metrics, new_incarnation()).run(stop)
        finally:
            transport.close()
    finally:
        metrics.close()
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
