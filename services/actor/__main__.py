"""Run an actor: `python -m services.actor`."""

import sys
from threading import Event

from common.service.config import load
from common.service.connection import connected
from common.service.process import DONE, run_service
from common.service.settings import new_incarnation
from services.actor.config import ActorConfig
from services.actor.service import ActorService

PROG = "python -m services.actor"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(ActorConfig, sys.argv[1:], prog=PROG, section="actor")
    with connected("actor", config, stop) as (transport, metrics):
        ActorService(config, transport, metrics, new_incarnation()).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
