"""A learner that trains in a group and does not lead it: it takes its own actors' rollouts, and trains with the rest.

It keeps no files and publishes no policy. Its accounts are in the leader's checkpoints.
"""

import logging
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

from common.comms.transport import Transport
from common.policy.contract import training_hash
from common.service.history import History
from common.service.member import Member
from common.service.metrics import Metrics
from services.learner import checkpoint, telemetry
from services.learner.admission import LearnerState
from services.learner.config import LearnerConfig
from services.learner.group import Group
from services.learner.lockstep import Lockstep
from services.learner.reception import Reception, in_order, lives, new_intake, where
from services.learner.service import TURN_WAIT_S
from services.learner.training import Training, new_training

log = logging.getLogger(__name__)


class FollowerService:
    """One rank of a group of learners, not the leading one.

    Args:
        config: Settings: the leader's.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        group: The learners that train together.
        clock: Returns seconds.
    """

    def __init__(
        self,
        config: LearnerConfig,
        transport: Transport,
        metrics: Metrics,
        group: Group,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._transport, self._metrics = config, transport, metrics
        self._group, self._clock = group, clock
        self._history = History(config.history, f"learner-{group.rank}")
        self._lockstep = Lockstep(
            group, config.intake.for_actors(config.actors).dataset_rollouts, transport.wait
        )
        self.training = new_training(config, group)
        self._training_hash = training_hash(config.task, config.network, config.experience)
        self._generation = int(group.of_leader(b""))
        extras = self._restored(self.training)
        self._intake = new_intake(config, group, self._learner_state(), extras, self.training.obs_size)
        self._member = Member("learner", config, transport, metrics, self._generation, id=str(group.rank))
        self._reception = Reception(
            *(config, group, transport, self._member, metrics, self._history, self._intake),
            self.training.obs_size,
            clock,
        )
        self._has_ended = False
        telemetry.begin(metrics)
        self._reception.members.join()
        self._history.note(
            "start", **where(self.training, self._generation), waiting=lives(self._intake.waiting)
        )

    def run(self, stop: Event) -> None:
        """Train until the group ends."""
        log.info("training with the group rank=%d of=%d", self._group.rank, self._group.size)
        try:
            while not self._has_ended:
                self.step(stop.is_set())
            self._give_accounts(is_last=True)
            self._history.note(
                "saved", **where(self.training, self._generation), waiting=lives(self._intake.waiting)
            )
            self._member.state = "done"
        finally:
            self._beat()
            self._member.leave()
            ledger = self._intake.total()
            self._history.note("end", trained=ledger.trained, balance=ledger.balance)
            self._history.close()
        log.info("stopped epoch=%d", self.training.progress.epoch)

    def step(self, is_stopping: bool = False) -> None:
        """Answer, and train this rank's part of an epoch if the group has a dataset."""
        self._serve()
        dataset, is_complete, self._has_ended = self._lockstep.turn(
            *(self._intake, self._clock(), is_stopping or self._member.is_draining), self._serve
        )
        if is_complete:
            self._member.state = "training"
            started = self._clock()
            stats = self.training.run_epoch([entry.rollout for entry in in_order(dataset)], self._serve)
            telemetry.measure_update(self._metrics, self._clock() - started)
            if stats.diverged:
                self._go_back()
            lost = self._intake.finish_update(self._learner_state())
            self._history.note(
                "trained", **where(self.training, self._generation), rollouts=lives(dataset), lost=lives(lost)
            )
            if self._lockstep.agrees(False):
                self._give_accounts(is_last=False)
        elif not self._has_ended:
            self._member.state = "waiting"
            self._transport.wait(TURN_WAIT_S)
        if self._member.is_due(self._clock()):
            self._beat()

    def _give_accounts(self, is_last: bool) -> None:
        """Give the leader what its checkpoint needs of this rank; it makes none of parameters that are not finite."""
        if self.training.is_finite:
            self._lockstep.collected(self._intake, keeps_queue=is_last)

    def _serve(self) -> None:
        self._reception.serve(self._clock())

    def _go_back(self) -> None:
        """Return to the leader's last good checkpoint, if it has one."""
        good = self._group.of_leader(b"")
        if good:
            self.training.go_back(lambda training: _restore(good, training))
        else:
            self.training.forget_health()

    def _restored(self, training: Training) -> checkpoint.Extras | None:
        """Load the checkpoint that the leader resumes from, if it resumes."""
        found = self._group.of_leader(b"")
        return _restore(found, training) if found else None

    def _learner_state(self) -> LearnerState:
        return self.training.state_of(self._config.run, self._generation, self._training_hash)

    def _beat(self) -> None:
        self._intake.tidy(self._clock())
        ledger = self._intake.total()
        telemetry.measure_state(self._metrics, ledger, self._intake, self._reception.members.roles)
        counters = {name: float(count) for name, count in telemetry.fates(ledger).items()}
        self._member.beat(
            counters, {"queued": self._intake.queued, "version": self.training.progress.version}
        )


def _restore(content: bytes, training: Training) -> checkpoint.Extras:
    """Load a checkpoint from its content."""
    with tempfile.NamedTemporaryFile(suffix=checkpoint.SUFFIX) as file:
        file.write(content)
        file.flush()
        return checkpoint.restore(Path(file.name), training)
