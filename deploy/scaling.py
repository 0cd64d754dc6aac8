"""More or fewer actors of a run that is running: how many are wanted, and what to start and end for it.

`topspin scale` writes the number into the run's folder, and `deploy.local` reads it. Who may write there may change the
run: no message of an open hub can.
"""

from collections.abc import Iterable

from common.comms.certificates import missing
from common.errors import ReportedError
from common.service.config_sources import read_toml
from common.service.run_folder import RunAliveError, RunFolder
from common.service.settings import MOST_ACTORS
from common.service.whole_file import write_whole


def ask(folder: RunFolder, actors: int) -> None:
    """Ask the process that keeps a run on this machine for so many actors.

    Raises:
        ReportedError: No `topspin train` keeps the run, or there is no certificate for one of the actors.
    """
    check_certificates(folder, actors)
    try:
        folder.check_free_of("deploy.local")
    except RunAliveError:
        if not folder.targets.is_file():  # it is there while somebody reads what is asked for
            raise ReportedError(
                f"the run {folder.root} is starting or ending; allowed: a run that trains, so ask again soon"
            ) from None
        write_whole(folder.wanted_actors, f"{actors}\n")
        return
    raise ReportedError(
        f"no topspin train keeps the run {folder.root}; allowed: the name of a run that one keeps. To a run that was "
        "started by hand add a services.actor, or end one"
    )


def check_certificates(folder: RunFolder, actors: int) -> None:
    """Raise ReportedError if the run has certificates, and none for one of its actors."""
    settings = read_toml(folder.config) if folder.config.is_file() else {}
    certificates = str(settings.get("tls", ""))
    if not certificates:
        return
    for name in missing(certificates, (f"actor-{number}" for number in range(actors))):
        raise ReportedError(
            f"{name} has no certificate in {certificates}; make it with topspin certs --out {certificates} "
            f"--add {name}, and start the run again with --resume: its hub reads the folder when it starts"
        )


def wanted(folder: RunFolder) -> int | None:
    """Return how many actors are asked for, or None: nobody asked, or for a number that is not allowed."""
    try:
        text = folder.wanted_actors.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return int(text) if text.isdecimal() and len(text) < 6 and 1 <= int(text) <= MOST_ACTORS else None


def changes(present: Iterable[int], actors: int) -> tuple[list[int], list[int]]:
    """Return the numbers of the actors to start and of those to end: actors 0, 1, ... remain."""
    now = set(present)
    return sorted(set(range(actors)) - now), sorted(number for number in now if number >= actors)
