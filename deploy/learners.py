"""`python -m deploy.learners RANKS LOGS [flags]`: learners that train together, as one process to watch.

Every rank is a learner with the flags, started as torchrun would start it (torchrun itself starts those of several
machines). The first that fails ends the others, since none can train alone, and its exit status is that of the group.
So whoever watches the group starts it again as it would a single learner.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from threading import Event
from typing import Final

from common.service.process import DONE, FAILED, run_service

WATCH_S: Final = 0.05
OTHERS_END_S: Final = 15.0  # time of the others to notice that one is lost
LONGEST_FOLDER: Final = 70  # bytes: a socket's path ends at 107, and the group's names are in it


def environment_of(rank: int, ranks: int, file: Path, own: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the environment that tells a learner its rank, and how it finds the others: on this machine only."""
    return {**own, "GROUP_FILE": str(file), "RANK": str(rank), "WORLD_SIZE": str(ranks)}


def start(ranks: int, logs: Path, flags: Sequence[str], file: Path) -> list[subprocess.Popen[bytes]]:
    """Start every rank, each with a log of its own."""
    started = []
    for rank in range(ranks):
        with (logs / f"learner-{rank}.log").open("ab") as log:
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", "deploy.child", "services.learner", *flags],
                    stdin=subprocess.PIPE,  # stays open: each rank ends when this process ends
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=environment_of(rank, ranks, file),
                )
            )
    return started


def watch(processes: Sequence[subprocess.Popen[bytes]], stop: Event) -> tuple[int, int] | None:
    """Wait until all have ended; return rank and exit status of the first that failed, or None.

    Args:
        processes: One for each rank.
        stop: Asks all of them to end in order.
    """
    failed: tuple[int, int] | None = None
    is_told, deadline = False, float("inf")
    while running := [process for process in processes if process.poll() is None]:
        if stop.is_set() and not is_told:
            is_told = True
            for process in running:
                process.terminate()
        if failed is None and (failed := first_failure(processes)):
            deadline = time.monotonic() + OTHERS_END_S
        if time.monotonic() > deadline:
            for process in running:
                process.kill()
        time.sleep(WATCH_S)
    return failed or first_failure(processes)


def first_failure(processes: Sequence[subprocess.Popen[bytes]]) -> tuple[int, int] | None:
    """Return rank and exit status of a process that failed, or None; where several have, of one that began it.

    One that has only lost another one fails with an error.
    """
    failed = [(rank, process.returncode) for rank, process in enumerate(processes) if process.returncode]
    return min(failed, key=lambda one: one[1] == FAILED, default=None)


def room_for_sockets(folder: str) -> str:
    """Return a folder for temporary files in which a socket's path is not too long: the usual one, or /tmp.

    Clusters have temporary folders with long names.
    """
    return folder if len(os.fsencode(folder)) <= LONGEST_FOLDER else "/tmp"


def main(stop: Event) -> int:
    """Run the group; return the exit status of the rank that failed first, or 0."""
    ranks, logs, flags = int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
    with TemporaryDirectory(prefix="topspin-", dir=room_for_sockets(gettempdir())) as folder:
        failed = watch(start(ranks, logs, flags, Path(folder) / "group"), stop)
    if failed is None:
        return DONE
    rank, status = failed
    lines = (logs / f"learner-{rank}.log").read_text(errors="replace").strip().splitlines()
    reason = lines[-1] if lines else "it said nothing"
    sys.stderr.write(f"learner of rank {rank} ended with status {status}: {reason}\n")
    if status < 0:  # this process ends as the rank did: a learner that was killed is started again at once
        end_by_signal(-status)
    return status


def end_by_signal(number: int) -> None:
    """End this process by a signal, as if it had met it."""
    sys.stderr.flush()
    if number != signal.SIGKILL:
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


if __name__ == "__main__":
    sys.exit(run_service("python -m deploy.learners", main))
