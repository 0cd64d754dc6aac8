"""A run's log: one row per epoch, in metrics.csv and as TensorBoard events."""

import logging
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.errors import ReportedError
from common.service import table
from common.service.table import Table
from common.task.reward import TERMS
from common.task.states import Outcome
from services.learner.epoch_stats import EpochStats

if TYPE_CHECKING:
    from tensorboard.summary.writer.event_file_writer import EventFileWriter


log = logging.getLogger(__name__)


class RunLogError(ReportedError):
    """A run's metrics.csv is no table of epochs: one line with the file."""


def row(stats: EpochStats, seconds: float, frames_per_s: float) -> dict[str, float]:
    """Return an epoch's row, by column; rates are of rallies with exploration noise, nan without rallies."""
    play, update, progress = stats.play, stats.update, stats.progress
    result = {
        "epoch": progress.epoch,
        "frames": progress.frames,
        "seconds": round(seconds, 3),
        "frames_per_s": round(frames_per_s, 1),
        "stage": progress.stage,
        "version": progress.version,
        "lag": stats.lag,
        "rallies": play.rallies,
        "unvalidated": play.unvalidated,
        "catch_rate": play.catch_rate,
        "over_rate": play.over_rate,
        "return_rate": play.return_rate,
        "target_error": play.target_error,
        "episode_return": play.mean_return,
        "policy_loss": update.policy_loss,
        "value_loss": update.value_loss,
        "bound_loss": update.bound_loss,
        "entropy": update.entropy,
        "kl": update.kl,
        "clip_fraction": update.clip_fraction,
        "importance_weight": update.weight,
        "gradient_norm": update.gradient_norm,
        "explained_variance": update.explained_variance,
        "learning_rate": update.learning_rate,
    }
    result.update(
        {f"reward_{name}": float(value) for name, value in zip(TERMS, play.reward_terms, strict=True)}
    )
    result.update(
        {f"outcome_{o.name.lower()}": int(play.outcomes[o]) for o in Outcome if o is not Outcome.NONE}
    )
    result["correction_loss"] = update.correction_loss
    return result


class RunLog:
    """Appends rows to the run folder; a resumed run continues the same file.

    Args:
        metrics: The CSV file.
        tensorboard: Folder of the events.
    """

    def __init__(self, metrics: Path, tensorboard: Path) -> None:
        self._path = metrics
        self._table: Table | None = None
        self._tensorboard = tensorboard
        self._events: EventFileWriter | None = None

    def append(self, values: dict[str, float]) -> None:
        """Write one epoch's row."""
        if self._table is None:
            self._table = Table(self._path, list(values))
        self._table.append(
            {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in values.items()}
        )
        try:
            self._write_events(values)
        except OSError as error:
            self._events = None  # its thread has ended: the next epoch begins another file
            log.error("can't write folder=%s reason=%s", self._tensorboard, error.strerror)

    def truncate(self, epoch: int, frames: int) -> None:
        """Drop rows after ``epoch``, and TensorBoard's events after ``frames``: what a resumed run trains again.

        Raises:
            RunLogError: The table has no column ``epoch``.
        """
        found = table.read(self._path)
        if found.columns:
            if "epoch" not in found.columns:
                raise RunLogError(f"{self._path}:1: no column epoch; got {', '.join(found.columns):.100}")
            # a learner that was killed may have left an incomplete line at the end
            kept = [row for row in found.rows if not float(row["epoch"] or "nan") > epoch]
            table.set_aside(self._path, found.refused)
            table.rewrite(self._path, found.columns, kept)
        files = sorted(self._tensorboard.glob("events.*"), reverse=True)
        if files:  # imported late, as in `_write_events`
            from services.learner.event_files import cut_after  # noqa: PLC0415
        for file in files:
            if not cut_after(file, frames):
                break

    def close(self) -> None:
        """Write TensorBoard's buffer."""
        if self._events is not None:
            with suppress(OSError):
                self._events.close()

    def _write_events(self, values: dict[str, float]) -> None:
        # Imported late: it takes a second, and the first batch should not wait for it.
        from tensorboard.compat.proto.event_pb2 import Event  # noqa: PLC0415
        from tensorboard.compat.proto.summary_pb2 import Summary  # noqa: PLC0415
        from tensorboard.summary.writer.event_file_writer import EventFileWriter  # noqa: PLC0415

        if self._events is None:
            self._events = EventFileWriter(str(self._tensorboard))
        group: dict[str, Any] = {"reward": "reward", "outcome": "outcome"}
        summary = Summary(
            value=[
                Summary.Value(
                    tag=f"{group.get(name.split('_')[0], 'training')}/{name}", simple_value=float(value)
                )
                for name, value in values.items()
                if name not in ("epoch", "frames")
            ]
        )
        self._events.add_event(Event(step=int(values["frames"]), summary=summary))
