"""Run the learner: `python -m services.learner`."""

import sys
from collections.abc import Sequence
from threading import Event

from common.comms.keys import Keys
from common.config import first_look, load
from common.connection import connected
from common.process import DONE, run_service
from common.run_folder import RunFolder
from services.learner import checkpoint
from services.learner.config import LearnerConfig
from services.learner.service import LearnerService

PROG = "python -m services.learner"


def settings(argv: Sequence[str]) -> LearnerConfig:
    """Return the learner's settings; with --resume those of the run's config.toml, but for what is given now."""
    asked, _ = first_look(LearnerConfig, ("run", "folder", "resume"), argv, prog=PROG, section="learner")
    file = RunFolder.of(asked.run, asked.folder).config
    if not (asked.resume and file.exists()):
        return load(LearnerConfig, argv, prog=PROG, section="learner")
    # Which run it is was given now: the file of a copied folder names the folder that it was copied from.
    which = {"run": asked.run} if not asked.folder else {}
    found = load(LearnerConfig, argv, prog=PROG, section="learner", recorded=file)
    return found.model_copy(update={"folder": asked.folder, **which})


def main(stop: Event) -> int:
    """Run the service until it is done or asked to stop; return the exit status."""
    config = settings(sys.argv[1:])
    Keys(config.run)  # refuses a name that can't stand in a key before a folder is made of it
    folder = RunFolder.of(config.run, config.folder)
    if config.resume:
        checkpoint.newest(folder.checkpoints)  # nothing to resume: nor is a folder made of the name
    with (
        folder.held_by("learner"),
        connected("learner", config, stop) as (transport, metrics),
    ):
        LearnerService(config, transport, metrics).run(stop)
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
