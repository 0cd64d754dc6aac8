"""Run an actor: `python -m services.actor`."""

# ruff: noqa: PLC0415 - what a service runs on is imported after its flags are read: --help answers at once

import sys
from threading import Event

from common.service.config import load
from common.service.process import DONE, run_service
from common.service.settings import new_incarnation
from services.actor.config import ActorConfig

PROG = "python -m services.actor"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(ActorConfig, sys.argv[1:], prog=PROG, section="actor")
    from common.service.connection import connected
    from services.actor.joining import joined
    from services.actor.service import ActorService

    if config.index < 0:
        place = joined(config, sys.argv[1:], PROG, stop)
        if place is None:
            return DONE
        config = place
    with connected("actor", config, stop) as (transport, metrics):
        ActorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
