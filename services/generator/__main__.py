"""Run a generator: `python -m services.generator`."""

import sys
from threading import Event

from common.service.config import load
from common.service.connection import connected
from common.service.process import DONE, run_service
from common.service.settings import new_incarnation
from services.generator.config import GeneratorConfig
from services.generator.service import GeneratorService

PROG = "python -m services.generator"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(GeneratorConfig, sys.argv[1:], prog=PROG, section="generator")
    with connected("generator", config, stop) as (transport, metrics):
        GeneratorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
