"""A run's folder: its paths and its locks."""

import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from common.errors import ReportedError

log = logging.getLogger(__name__)

RUNS = Path("runs")
LATEST = "latest"
CONFIG = "config.toml"

Holder = Literal["learner", "deploy.local"]
LOCKS: Final[dict[Holder, str]] = {"deploy.local": ".deploy.lock", "learner": ".lock"}
"""The lock file of each writer of a run folder. There are two, since deploy.local starts a learner and both hold their
lock at the same time."""
_NO_LOCKS: Final = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)  # a file system without locks


class RunAliveError(ReportedError):
    """Another process uses the run folder: one line that names it."""


def newest_run() -> str:
    """Return the name of the newest run: that of runs/latest, else the one whose settings were written last, or ""."""
    link = RUNS / LATEST
    if link.is_symlink() and (link / CONFIG).is_file():
        return link.resolve().name
    files = [file for file in RUNS.glob(f"*/{CONFIG}") if file.parent.name != LATEST]
    return max(files, key=lambda file: file.stat().st_mtime).parent.name if files else ""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @staticmethod
    def of(run: str, folder: str = "") -> "RunFolder":
        """Return the folder of a run: runs/RUN unless another is given; ``latest`` is the newest run."""
        if folder:
            return RunFolder(Path(folder))
        return RunFolder(RUNS / ((newest_run() or LATEST) if run == LATEST else run))

    @property
    def config(self) -> Path:
        """Every setting of the run."""
        return self.root / CONFIG

    @property
    def metrics(self) -> Path:
        """One row an epoch."""
        return self.root / "metrics.csv"

    @property
    def tensorboard(self) -> Path:
        """TensorBoard events."""
        return self.root / "tb"

    @property
    def generation(self) -> Path:
        """How many learners the run has had, as a number."""
        return self.root / ".generation"

    @property
    def checkpoints(self) -> Path:
        """Checkpoints, from which --resume continues."""
        return self.root / "checkpoints"

    @property
    def latest_policy(self) -> Path:
        """The newest policy."""
        return self.root / "policy" / "latest"

    @property
    def best_policy(self) -> Path:
        """The best policy by evaluation."""
        return self.root / "policy" / "best"

    def evaluated_policy(self, version: int) -> Path:
        """The policy of one evaluation, where all are kept."""
        return self.root / "policy" / "evaluated" / f"{version:08d}"

    @property
    def logs(self) -> Path:
        """One log a process."""
        return self.root / "logs"

    @property
    def targets(self) -> Path:
        """The addresses of the live services' /metrics, for Prometheus' file discovery."""
        return self.root / "targets.json"

    @property
    def wanted_actors(self) -> Path:
        """How many actors the run is asked to have, while it runs."""
        return self.root / "actors"

    @property
    def report(self) -> Path:
        """Evaluations and reports."""
        return self.root / "report"

    @property
    def evaluations(self) -> Path:
        """The evaluator's curve: one row an evaluation."""
        return self.report / "evaluations.csv"

    @property
    def final(self) -> Path:
        """The one line of a run that ended: its summary, with the measures of its last policy."""
        return self.report / "final.json"

    def create(self) -> None:
        """Make the folders."""
        for path in (self.tensorboard, self.checkpoints, self.latest_policy.parent, self.logs, self.report):
            path.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def held_by(self, holder: Holder) -> Iterator[None]:
        """Hold the lock of ``holder`` on the folder. The kernel releases it when the process ends, also after a crash.

        Raises:
            RunAliveError: Another process holds it.
        """
        self.root.mkdir(parents=True, exist_ok=True)
        # Child processes must not inherit the file: the lock lives as long as any process has it open.
        file = self._open(holder, os.O_RDWR | os.O_CREAT)
        try:
            self._take(file, fcntl.LOCK_EX, holder)
            os.truncate(file, 0)
            os.write(file, f"{os.getpid()}\n".encode())
            yield
        finally:
            os.close(
                file
            )  # the file stays: removing it could remove a lock that another process has just taken

    def check_free_of(self, holder: Holder) -> None:
        """Raise RunAliveError if a ``holder`` uses the folder; nothing is written."""
        try:
            file = self._open(holder, os.O_RDONLY)
        except FileNotFoundError:
            return
        try:
            self._take(file, fcntl.LOCK_SH, holder)
        finally:
            os.close(file)

    def _lock(self, holder: Holder) -> Path:
        return self.root / LOCKS[holder]

    def _open(self, holder: Holder, how: int) -> int:
        try:
            return os.open(self._lock(holder), how | os.O_CLOEXEC, 0o644)
        except PermissionError as error:
            raise ReportedError(f"can't open {self._lock(holder)}: {error.strerror}") from None

    def _take(self, file: int, how: int, holder: Holder) -> None:
        try:
            fcntl.flock(file, how | fcntl.LOCK_NB)
        except BlockingIOError:
            process = self._lock(holder).read_text().strip() or "that is just starting"
            raise RunAliveError(
                f"run {self.root.name!r} is alive: {holder}, process {process}, uses {self.root}; "
                "end it first, or choose another --run"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            log.warning(
                "can't be locked folder=%s reason=%s: make sure that no other process uses it",
                self.root,
                error.strerror,
            )

    def point_latest_here(self) -> None:
        """Point runs/latest to this run; a convenience for people, which a file system without links does not have."""
        link = self.root.parent / LATEST
        if link.is_dir() and not link.is_symlink():
            log.warning("%s is a folder and not a link to the newest run; it stays as it is", link)
            return
        fresh = link.with_name(f".{LATEST}-{os.getpid()}")
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self.root.name)
            os.replace(fresh, link)
        except OSError as error:
            log.info("no link to the newest run file=%s reason=%s", link, error.strerror)
