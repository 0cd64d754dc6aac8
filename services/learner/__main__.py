"""Run the learner: `python -m services.learner`."""

import sys
from threading import Event

from common.comms.zenoh_transport import open_zenoh
from common.config import load
from common.log import set_up_logging
from common.metrics import Metrics
from common.process import DONE, run_service
from services.learner.config import LearnerConfig
from services.learner.service import LearnerService

PROG = "python -m services.learner"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(LearnerConfig, sys.argv[1:], prog=PROG, section="learner")
    set_up_logging(config.log_level, f"learner/{config.id}")
    metrics = Metrics("learner", config.id)
    metrics.serve(config.metrics_port, config.metrics_host)
    try:
        transport = open_zenoh(config, stop)
        try:
            LearnerService(config, transport, metrics).run(stop)
        finally:
            transport.close()
    finally:
        metrics.close()
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
