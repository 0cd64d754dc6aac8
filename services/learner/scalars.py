"""A run's curves: names and values of an epoch's and of an evaluation's scalars, and who writes them.

TensorBoard's events are always written. Other programs have a writer: a class that an installed package names in the
entry points `topspin.writers`. Topspin names those for Weights & Biases and MLflow (`trackers`), and a person's own
package may name more. Nothing is sent anywhere unless a run names a writer.
"""

import math
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from common.errors import ConfigError, ReportedError
from common.task.reward import TERMS

if TYPE_CHECKING:
    from tensorboard.summary.writer.event_file_writer import EventFileWriter

ENTRY_POINTS: Final = "topspin.writers"
GROUPS: Final[dict[str, tuple[str, ...]]] = {
    "play": ("catch_rate", "over_rate", "return_rate", "target_error", "episode_return"),
    "progress": ("stage", "version", "lag", "frames_per_s"),
    "update": (
        *("policy_loss", "value_loss", "bound_loss", "correction_loss", "entropy", "kl", "clip_fraction"),
        *("importance_weight", "gradient_norm", "explained_variance", "learning_rate"),
    ),
    "reward": tuple(f"reward_{term}" for term in TERMS),
}
"""Columns of metrics.csv by the group of curves that shows them. Outcomes are shares of the rallies in `outcome`; other
counts are no curves."""
EVALUATION: Final = {
    "catch_rate": "catch_rate",
    "over_rate": "over_rate",
    "return_rate": "return_rate",
    "target_error_mean": "target_error",
}
"""Columns of evaluations.csv, and their names as curves in the group `evaluation`."""
_OUTCOME: Final = "outcome_"


def scalars(row: Mapping[str, float]) -> dict[str, float]:
    """Return an epoch's scalars by name, such as ``play/return_rate``, from its row of metrics.csv.

    A value that there is not yet, such as a rate of no rallies, is left out.
    """
    found = {
        f"{group}/{name.removeprefix(f'{group}_')}": float(row[name])
        for group, names in GROUPS.items()
        for name in names
        if name in row
    }
    if rallies := row.get("rallies", 0):
        found |= {
            f"outcome/{name.removeprefix(_OUTCOME)}": count / rallies
            for name, count in row.items()
            if name.startswith(_OUTCOME)
        }
    return {name: value for name, value in found.items() if math.isfinite(value)}


def evaluation_scalars(row: Mapping[str, str]) -> dict[str, float]:
    """Return an evaluation's scalars by name, from its row of evaluations.csv."""
    return {
        f"evaluation/{name}": float(row[column]) for column, name in EVALUATION.items() if row.get(column)
    }


class ScalarWriter(Protocol):
    """Receives a run's curves."""

    def write(self, frames: int, scalars: Mapping[str, float]) -> None:
        """Write scalars by name at a number of trained frames. An OSError is logged, and training goes on."""

    def close(self) -> None:
        """Write what is not written yet."""


class TensorBoardWriter:
    """Writes TensorBoard's events.

    Args:
        folder: Of the events.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._events: EventFileWriter | None = None

    def write(self, frames: int, scalars: Mapping[str, float]) -> None:
        """Write scalars at a number of trained frames."""
        # Imported late: it takes a second, and the first batch should not wait for it.
        from tensorboard.compat.proto.event_pb2 import Event  # noqa: PLC0415
        from tensorboard.compat.proto.summary_pb2 import Summary  # noqa: PLC0415
        from tensorboard.summary.writer.event_file_writer import EventFileWriter  # noqa: PLC0415

        summary = Summary(value=[Summary.Value(tag=name, simple_value=scalars[name]) for name in scalars])
        try:
            if self._events is None:
                self._events = EventFileWriter(str(self._folder))
            self._events.add_event(Event(step=frames, summary=summary))
        except OSError:
            self._events = None  # its thread has ended: the next epoch begins another file
            raise

    def close(self) -> None:
        """Write TensorBoard's buffer."""
        if self._events is not None:
            self._events.close()


def own_writers(names: Sequence[str], run: str, folder: Path) -> list[ScalarWriter]:
    """Return the writers that installed packages offer under these names.

    Each entry point is called with the run's name and its folder.

    Raises:
        ConfigError: There is none of this name.
        ReportedError: A writer can't begin.
    """
    known = {point.name: point for point in entry_points(group=ENTRY_POINTS)}
    for name in names:
        if name not in known:
            installed = ", ".join(sorted(known)) or "none is installed"
            raise ConfigError(
                f"writers {name!r}: no entry point of this name in the group {ENTRY_POINTS}; allowed: {installed}"
            )
    found = []
    for name in names:
        try:
            found.append(known[name].load()(run, folder))
        except OSError as error:
            raise ReportedError(f"writer {name} can't begin: {error}") from None
    return found
