"""A run's real processes, for a benchmark: started together, and stopped in order at the end."""

from collections.abc import Iterator
from contextlib import contextmanager

from common.errors import ReportedError
from deploy.prepare import PreparedRun
from deploy.run import LEARNER, end
from deploy.supervisor import Supervisor


@contextmanager
def running(run: PreparedRun) -> Iterator[Supervisor]:
    """Yield the supervisor of a run's processes. At the end the learner stops last, since it answers the others."""
    supervisor = Supervisor(run.specs(), run.folder.logs)
    try:
        yield supervisor
    finally:
        end(supervisor, workers_first=True)


def check_learner(run: PreparedRun, supervisor: Supervisor) -> None:
    """Raise ReportedError if the learner has ended."""
    if supervisor.status_of(LEARNER) is not None:
        raise ReportedError(f"the learner ended early: see {run.folder.logs / f'{LEARNER}.log'}")
