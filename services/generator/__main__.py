"""Run a generator: `python -m services.generator`."""

import sys
from threading import Event

from common.comms.zenoh_transport import open_zenoh
from common.config import load
from common.log import set_up_logging
from common.metrics import Metrics
from common.process import DONE, run_service
from common.service_config import new_incarnation
from services.generator.config import GeneratorConfig
from services.generator.service import GeneratorService

PROG = "python -m services.generator"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(GeneratorConfig, sys.argv[1:], prog=PROG, section="generator")
    set_up_logging(config.log_level, f"generator/{config.id}")
    metrics = Metrics("generator", config.id)
    metrics.serve(config.metrics_port, config.metrics_host)
    try:
        transport = open_zenoh(config, stop)
        try:
            GeneratorService(config, transport, metrics, new_incarnation()).run(stop)
        finally:
            transport.close()
    finally:
        metrics.close()
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
