"""What a learner keeps of its run: checkpoints, the newest policy, and the last good state to go back to."""

import logging
import time
from collections.abc import Sequence
from pathlib import Path

from common.errors import ReportedError
from common.policy.contract import Contract, contract_of
from common.policy.folder import save_policy
from common.service.history import History
from common.service.metrics import Metrics
from common.service.run_folder import RunFolder
from services.learner import checkpoint
from services.learner.config import LearnerConfig
from services.learner.divergence import NOT_FINITE
from services.learner.group import Group
from services.learner.reception import where
from services.learner.training import Training

log = logging.getLogger(__name__)


class NotSavedError(ReportedError):
    """The run folder can't be written."""


class DivergedError(ReportedError):
    """Training has diverged and cannot go back."""


class Keeper:
    """Writes a run's checkpoints and policies, and reads them.

    Args:
        config: Settings of the learner.
        folder: The run's.
        training: Saved and restored.
        group: The learners that train together; the others get the checkpoint that training goes back to.
        metrics: Receives time and failures of saves.
        history: Records them.
    """

    def __init__(
        self,
        config: LearnerConfig,
        folder: RunFolder,
        training: Training,
        group: Group,
        metrics: Metrics,
        history: History,
    ) -> None:
        self._config, self._folder, self._training = config, folder, training
        self._group, self._metrics, self._history = group, metrics, history

    def restore(self) -> tuple[Path, checkpoint.Extras]:
        """Load the newest whole checkpoint; return it, and what the service keeps in it.

        Raises:
            CheckpointError: There is none, or it is of another training.
        """
        file, extras = checkpoint.restore_newest(self._folder.checkpoints, self._training)
        progress = self._training.progress
        log.info(
            "resumed file=%s epoch=%d frames=%d waiting=%d",
            file,
            progress.epoch,
            progress.frames,
            len(extras.queue),
        )
        return file, extras

    def save(self, extras: checkpoint.Extras, waiting: Sequence[tuple[str, int, int]], is_last: bool) -> None:
        """Write checkpoint and policy/latest.

        Where that fails, such as on a full disk, training goes on, and the next one is tried in its time.

        Args:
            extras: What the service keeps with the training's state.
            waiting: Names of the rollouts in it, for the history.
            is_last: Whether this process trains no more.

        Raises:
            NotSavedError: The last state can't be saved.
        """
        try:
            self._save(extras, waiting)
        except OSError as error:
            self._metrics.inc("topspin_failed_saves_total")
            failed = error.filename or self._folder.root
            text = f"epoch {self._training.progress.epoch} can't be saved in {failed}: {error.strerror}"
            if is_last:
                older = checkpoint.checkpoints(self._folder.checkpoints)
                kept = f"the newest checkpoint is {older[-1]}" if older else "there is no checkpoint"
                raise NotSavedError(f"{text}; {kept}") from None
            log.error("%s; training goes on, next try in %.0f s", text, self._config.checkpoint_interval_s)

    def go_back(self, reason: str) -> None:
        """Return to the last good checkpoint, if there is one.

        Raises:
            DivergedError: There is none, and the parameters are not finite.
        """
        good = checkpoint.checkpoints(self._folder.checkpoints / checkpoint.GOOD)
        if not good:
            if reason == NOT_FINITE:
                raise DivergedError(
                    f"training has diverged: {reason}, and there is no good checkpoint to go back to; "
                    "try a lower ppo.learning_rate_max, or learning_rate where the schedule is the paper's"
                )
            self._group.of_leader(b"")
            self._training.forget_health()
            log.warning("training has diverged reason=%r; no good checkpoint yet, going on", reason)
            return
        path = good[-1]
        if self._group.size > 1:
            self._group.of_leader(path.read_bytes())
        self._training.go_back(lambda training: checkpoint.restore(path, training))
        self._metrics.inc("topspin_rollbacks_total")
        log.warning("training has diverged reason=%r; went back to file=%s", reason, path)

    def _save(self, extras: checkpoint.Extras, waiting: Sequence[tuple[str, int, int]]) -> None:
        training = self._training
        path = checkpoint.save(self._folder.checkpoints, training, extras)
        if training.progress.is_worth_going_back_to:
            checkpoint.keep(path, self._folder.checkpoints / checkpoint.GOOD)
        weights = training.weights(self._config.evaluated_weights)
        save_policy(
            self._folder.latest_policy, weights, training.obs_moments, self._contract(extras.generation)
        )
        self._metrics.set("topspin_checkpoint_time_seconds", time.time())
        self._history.note("saved", **where(training, extras.generation), waiting=waiting)
        log.debug("checkpoint written file=%s", path)

    def _contract(self, generation: int) -> Contract:
        config, progress = self._config, self._training.progress
        return contract_of(
            config.task,
            config.experience,
            config.network,
            run=config.run,
            generation=generation,
            version=progress.version,
            stage=progress.stage,
            frames=progress.frames,
        )
