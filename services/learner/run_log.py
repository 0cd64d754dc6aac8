"""A run's log: one row per epoch, in metrics.csv and as curves."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from common.errors import ReportedError
from common.service import table
from common.service.table import Table, whole_rows
from common.task.reward import TERMS
from common.task.states import Outcome
from services.learner.epoch_stats import EpochStats
from services.learner.scalars import ScalarWriter, TensorBoardWriter, evaluation_scalars, scalars

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
        evaluations: The evaluator's CSV file, whose rows become curves too.
        writers: Of curves, besides TensorBoard's.
    """

    def __init__(
        self, metrics: Path, tensorboard: Path, evaluations: Path, writers: Sequence[ScalarWriter] = ()
    ) -> None:
        self._path = metrics
        self._table: Table | None = None
        self._tensorboard, self._evaluations = tensorboard, evaluations
        self._writers = (TensorBoardWriter(tensorboard), *writers)
        self._evaluations_size = 0  # [bytes] of what was read
        self._evaluations_read = 0  # rows

    def append(self, values: dict[str, float]) -> None:
        """Write one epoch's row."""
        if self._table is None:
            self._table = Table(self._path, list(values))
        self._table.append(
            {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in values.items()}
        )
        self._write(int(values["frames"]), scalars(values))
        for row in self._new_evaluations(int(values["frames"])):
            self._write(int(float(row["frames"])), evaluation_scalars(row))

    def truncate(self, epoch: int, frames: int) -> None:
        """Drop rows after ``epoch``, and TensorBoard's events after ``frames``: what a resumed run trains again.

        The evaluations so far count as written.

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
        self._evaluations_read = len(whole_rows(self._evaluations))
        files = list(self._tensorboard.glob("events.*"))
        if files:  # imported late, as in `TensorBoardWriter`
            from services.learner.event_files import cut_after  # noqa: PLC0415
        for file in files:  # all of them: after a clock step their names are not in the order of their steps
            cut_after(file, frames)

    def close(self) -> None:
        """Write what the writers keep back."""
        for writer in self._writers:
            with suppress(OSError):
                writer.close()

    def _write(self, frames: int, found: Mapping[str, float]) -> None:
        for writer in self._writers:
            try:
                writer.write(frames, found)
            except OSError as error:
                log.error(
                    "can't write the curves folder=%s reason=%s", self._tensorboard, error.strerror or error
                )

    def _new_evaluations(self, frames: int) -> list[dict[str, str]]:
        """Return the evaluations since the last call, of policies with up to ``frames``.

        A learner that was restarted may find one that was begun before, of a policy that is no more.
        """
        size = self._evaluations.stat().st_size if self._evaluations.is_file() else 0
        if size == self._evaluations_size:
            return []
        self._evaluations_size = size
        fresh = whole_rows(self._evaluations)[self._evaluations_read :]
        self._evaluations_read += len(fresh)
        return [row for row in fresh if row.get("frames") and float(row["frames"]) <= frames]
