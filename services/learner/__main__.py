"""Run the learner: `python -m services.learner`."""

import sys
from threading import Event

from common.comms.keys import Keys
from common.config import load
from common.connection import connected
from common.process import DONE, run_service
from common.run_folder import RunFolder
from services.learner.config import LearnerConfig
from services.learner.service import LearnerService

PROG = "python -m services.learner"


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = load(LearnerConfig, sys.argv[1:], prog=PROG, section="learner")
    Keys(config.run)  # refuses a name that can't stand in a key before a folder is made of it
    with (
        RunFolder.of(config.run, config.folder).held_by("learner"),
        connected("learner", config, stop) as (transport, metrics),
    ):
        LearnerService(config, transport, metrics).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
