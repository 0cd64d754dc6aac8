"""A run's real processes, for a benchmark: started together, and stopped in order at the end."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from common.errors import ReportedError
from deploy.prepare import PreparedRun
from deploy.run import LEARNER
from deploy.supervisor import Supervisor

WORKER_PATIENCE_S: Final = 10.0
LEARNER_PATIENCE_S: Final = 30.0


@contextmanager
def running(run: PreparedRun) -> Iterator[Supervisor]:
    """Yield the supervisor of a run's processes. At the end the learner stops last, since it answers the others."""
    supervisor = Supervisor(run.specs(), run.folder.logs)
    try:
        yield supervisor
    finally:
        supervisor.stop([name for name in supervisor.children if name != LEARNER], WORKER_PATIENCE_S)
        supervisor.stop([LEARNER], LEARNER_PATIENCE_S)


def check_learner(run: PreparedRun, supervisor: Supervisor) -> None:
    """Raise ReportedError if the learner has ended."""
    if supervisor.status_of(LEARNER) is not None:
        raise ReportedError(f"the learner ended early: see {run.folder.logs / f'{LEARNER}.log'}")
