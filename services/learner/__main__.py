"""Run the learner: `python -m services.learner`, or several that train together: `torchrun -m services.learner`."""

# ruff: noqa: PLC0415 - what a service runs on is imported after its flags are read: --help answers at once

import json
import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from common.comms.keys import Keys
from common.service.config import first_look, load
from common.service.config_sources import named_file, read_toml
from common.service.process import DONE, run_service
from common.service.run_folder import RunFolder
from services.learner.config import LearnerConfig

if TYPE_CHECKING:
    from services.learner.group import Group

PROG = "python -m services.learner"


def settings(argv: Sequence[str]) -> LearnerConfig:
    """Return the learner's settings; with --resume those of the run's config.toml, except for flags given now."""
    names = ("run", "folder", "resume", "auto_resume")
    asked = first_look(LearnerConfig, names, argv, prog=PROG, section="learner")
    from services.learner import checkpoint

    folder = RunFolder.of(asked.run, asked.folder)
    is_resumed = asked.resume
    if asked.auto_resume and not is_resumed and checkpoint.checkpoints(folder.checkpoints):
        argv, is_resumed = [*argv, "--resume"], True
    file = folder.config
    if not (is_resumed and file.exists()):
        return load(LearnerConfig, argv, prog=PROG, section="learner")
    found = load(LearnerConfig, argv, prog=PROG, section="learner", recorded=file)
    # The flag's name wins: the file in a copied folder has the name of the original run.
    return found if asked.folder else found.model_copy(update={"run": asked.run})


def main(stop: Event) -> int:
    """Run one learner until it is done or asked to stop; return the exit status.

    torchrun tells each of its processes its rank. Rank 0 leads, and its settings are those of all.
    """
    if os.environ.get("RANK", "0") != "0":
        return follow(stop)
    config, file = settings(sys.argv[1:]), named_file(sys.argv[1:], os.environ)
    from services.learner.group import ALONE, join

    if "WORLD_SIZE" not in os.environ:
        return lead(config, ALONE, stop, file)
    group = join()
    try:
        return lead(config, group, stop, file)
    finally:
        group.leave()


def lead(config: LearnerConfig, group: "Group", stop: Event, file: Path | None) -> int:
    """Run the learner that keeps the run.

    Args:
        config: Its settings.
        group: Learners that train together.
        stop: Ends it.
        file: The settings file that it was given. Its table [actor] becomes the run's, for actors that join.
    """
    from common.comms.zenoh_config import endpoint_for_others
    from common.service.connection import connected
    from services.learner import checkpoint
    from services.learner.service import LearnerService

    Keys(config.run)  # refuses a name that can't be part of a key, before a folder is created
    folder = RunFolder.of(config.run, config.folder)
    actor = read_toml(file).get("actor", {}) if file else {}
    if config.resume:
        checkpoint.newest(folder.checkpoints)  # raises before a folder is created, if there is no checkpoint
    with (
        folder.held_by("learner"),
        connected("learner", config, stop) as (transport, metrics),
    ):
        if group.size > 1:
            endpoint = endpoint_for_others(config.endpoint, socket.gethostname())
            group.of_leader(settings_for_others(config, endpoint))
        LearnerService(config, transport, metrics, group=group, actor=actor).run(stop)
    return DONE


def settings_for_others(config: LearnerConfig, endpoint: str) -> bytes:
    """Return the settings of the learners that train with the leading one.

    A resumed run is told, although no settings file says so: what it began with may be gone.
    """
    return json.dumps(
        config.model_dump(mode="json") | {"endpoint": endpoint, "resume": config.resume}
    ).encode()


def follow(stop: Event) -> int:
    """Run a learner that trains with the leading one, with its settings."""
    from common.service.connection import connected
    from services.learner.follower import FollowerService
    from services.learner.group import join

    group = join()
    try:
        leaders = LearnerConfig.model_validate_json(group.of_leader(b""))
        config = leaders.model_copy(update={"id": str(group.rank), "mode": "client"})
        with connected("learner", config, stop) as (transport, metrics):
            FollowerService(config, transport, metrics, group).run(stop)
    finally:
        group.leave()
    return DONE


if __name__ == "__main__":
    sys.exit(run_service(PROG, main))
