"""A run's curves in Weights & Biases or MLflow: `--writers wandb` or `--writers mlflow`, with the extra of that name.

Where they send them is the programs' own setting: ``WANDB_MODE=offline``, ``MLFLOW_TRACKING_URI``. A resumed run goes
on with its curves. What both draw over is the number of trained frames.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from common.errors import ConfigError, ReportedError

PROJECT = "topspin"
FRAMES = "frames"


class WandbWriter:
    """Writes curves with Weights & Biases.

    Args:
        run: The run's name.
        folder: Its folder, which gets the program's files too.
    """

    def __init__(self, run: str, folder: Path) -> None:
        wandb = _imported("wandb")
        with _as_os_errors(wandb.errors.Error):
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                id=f"{PROJECT}-{run}",
                name=run,
                dir=str(folder),
                resume="allow",
            )
            # Evaluations arrive behind their frames, and wandb leaves out steps that go back: so frames are a value
            self._run.define_metric("*", step_metric=FRAMES)
        self._error: type[Exception] = wandb.errors.Error

    def write(self, frames: int, scalars: Mapping[str, float]) -> None:
        """Write scalars at a number of trained frames."""
        with _as_os_errors(self._error):
            self._run.log({**scalars, FRAMES: frames})

    def close(self) -> None:
        """Write what is not written yet."""
        with _as_os_errors(self._error):
            self._run.finish()


class MlflowWriter:
    """Writes curves with MLflow.

    Args:
        run: The run's name.
        folder: Its folder, which gets nothing.

    Raises:
        ConfigError: MLflow's address is not set.
    """

    def __init__(self, run: str, folder: Path) -> None:
        mlflow = _imported("mlflow")
        where = os.environ.get("MLFLOW_TRACKING_URI")
        if not where:
            raise ConfigError("--writers mlflow needs MLFLOW_TRACKING_URI, such as http://HOST:5000")
        self._error: type[Exception] = mlflow.exceptions.MlflowException
        with _as_os_errors(self._error):
            self._client = mlflow.MlflowClient(tracking_uri=where)
            self._id = (
                self._found(run) or self._client.create_run(self._experiment(), run_name=run).info.run_id
            )

    def write(self, frames: int, scalars: Mapping[str, float]) -> None:
        """Write scalars at a number of trained frames."""
        with _as_os_errors(self._error):
            for name, value in scalars.items():
                self._client.log_metric(self._id, name, value, step=frames)

    def close(self) -> None:
        """End the run."""
        with _as_os_errors(self._error):
            self._client.set_terminated(self._id)

    def _experiment(self) -> str:
        found = self._client.get_experiment_by_name(PROJECT)
        known: str = found.experiment_id if found else self._client.create_experiment(PROJECT)
        return known

    def _found(self, run: str) -> str:
        """Return the id of the newest run of this name, or ""."""
        found = self._client.search_runs(
            [self._experiment()], f"attributes.run_name = '{run}'", max_results=1
        )
        return str(found[0].info.run_id) if found else ""


def _imported(name: str) -> ModuleType:
    """Return a library that is an extra."""
    try:
        library = __import__(name)
    except ModuleNotFoundError as error:
        raise ReportedError(f"--writers {name} needs {error.name}: pip install -e '.[{name}]'") from None
    return library


@contextmanager
def _as_os_errors(kind: type[Exception]) -> Iterator[None]:
    """Raise a library's error as what a writer may raise: it is logged, and training goes on."""
    try:
        yield
    except kind as error:
        raise OSError(f"{kind.__module__.partition('.')[0]}: {error}") from error
