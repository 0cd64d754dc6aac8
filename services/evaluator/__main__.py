"""Run the evaluator: `python -m services.evaluator`."""

# ruff: noqa: PLC0415 - what a service runs on is imported after its flags are read: --help answers at once

import os
import sys
from threading import Event
from typing import Final

from common.service.config import load
from common.service.process import DONE, run_service
from common.service.settings import new_incarnation
from services.evaluator.config import EvaluatorConfig

PROG: Final = "python -m services.evaluator"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(EvaluatorConfig, sys.argv[1:], prog=PROG, section="evaluator")
    os.nice(config.niceness)
    from common.service.connection import connected
    from services.evaluator.service import EvaluatorService

    with connected("evaluator", config, stop) as (transport, metrics):
        EvaluatorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
