"""Run a generator: `python -m services.generator`."""

# ruff: noqa: PLC0415 - what a service runs on is imported after its flags are read: --help answers at once

import sys
from threading import Event

from common.service.config import load
from common.service.process import DONE, run_service
from common.service.settings import new_incarnation
from services.generator.config import GeneratorConfig

PROG = "python -m services.generator"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(GeneratorConfig, sys.argv[1:], prog=PROG, section="generator")
    from common.service.connection import connected
    from services.generator.service import GeneratorService

    with connected("generator", config, stop) as (transport, metrics):
        GeneratorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
