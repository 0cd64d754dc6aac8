"""The learner's shell: takes rollouts in, trains epochs, broadcasts policies and stage changes, keeps the run."""

import logging
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from types import MappingProxyType
from typing import Any, Final

from common.comms.messages import StageChange
from common.comms.transport import Transport
from common.comms.zenoh_config import endpoint_for_others
from common.env.teacher import teacher_of
from common.errors import ReportedError
from common.policy.contract import contract_hash, training_hash
from common.service.config import save_settings, to_tables
from common.service.history import History
from common.service.member import LEARNER_ID, Member
from common.service.metrics import Metrics
from common.service.run_folder import RunFolder
from services.learner import checkpoint, telemetry
from services.learner.admission import LearnerState
from services.learner.broadcast import Broadcast, Identity
from services.learner.budget import ENDING_S, NOTHING_LEFT, Budget
from services.learner.config import LearnerConfig
from services.learner.generation import next_generation
from services.learner.group import ALONE, Group
from services.learner.intake import Queued
from services.learner.keeper import Keeper
from services.learner.ledger import Ledger
from services.learner.lockstep import Lockstep
from services.learner.members import IDLE_WAIT_S
from services.learner.places import Places, Registrar
from services.learner.reception import Reception, in_order, lives, new_intake, where
from services.learner.run_log import RunLog, row
from services.learner.scalars import own_writers
from services.learner.training import new_training

log = logging.getLogger(__name__)

TURN_WAIT_S: Final = 0.02  # pause between the turns of a group that waits for rollouts


class RunExistsError(ReportedError):
    """A new run would overwrite an old one's checkpoints."""


@dataclass(slots=True)
class Clocks:
    """Times of events of the learner's process [s on its clock]."""

    born: float
    first_trained: float = -1.0
    last_trained: float = -1.0
    next_checkpoint: float = 0.0
    resumed_seconds: float = 0.0


class LearnerService:
    """The learner of one run, or the one that leads its group of learners.

    Args:
        config: Settings.
        transport: The hub, or a connection to one.
        metrics: Receives the service's numbers.
        clock: Returns seconds.
        group: The learners that train together.
        actor: Settings of the actors that the learner's own settings file has, for those that join.
    """

    def __init__(
        self,
        config: LearnerConfig,
        transport: Transport,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
        group: Group = ALONE,
        actor: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self._config, self._transport, self._metrics, self._clock = config, transport, metrics, clock
        self._group = group
        endpoint = endpoint_for_others(config.endpoint, socket.gethostname())
        self._link = f"--endpoint {endpoint}" + (
            f" --tls {config.tls}" if config.tls else ""
        )  # flags for others
        self._folder = RunFolder.of(config.run, config.folder)
        if not config.resume and checkpoint.checkpoints(self._folder.checkpoints):
            raise RunExistsError(
                f"run {config.run!r} has checkpoints in {self._folder.checkpoints}: "
                "go on with --resume, or choose another --run"
            )
        task, teacher = config.task, config.experience.teacher
        # Before a folder is made: teacher and start policy may not fit
        if not config.resume:
            teacher_of(task, teacher)
        self.training = new_training(config, group)
        self._folder.create()
        writers = own_writers(config.writers, config.run, self._folder.root)
        self._run_log = RunLog(
            self._folder.metrics, self._folder.tensorboard, self._folder.evaluations, writers
        )
        self._dataset_rollouts = config.intake.for_actors(config.actors).dataset_rollouts
        self._lockstep = Lockstep(group, self._dataset_rollouts, transport.wait)
        self._training_hash = training_hash(task, config.network, config.experience)
        self._clocks = Clocks(clock())
        self._history = History(config.history, "learner-0")
        self._keeper = Keeper(config, self._folder, self.training, group, metrics, self._history)
        file, extras = self._restore() if config.resume else (None, None)
        if self.training.is_distilling:
            # Raises here if the teacher does not fit: otherwise actors would end because of it, for ever restarted
            teacher_of(task, teacher)
        stages = tuple(StageChange(**change) for change in extras.stage_log) if extras else ()
        self._generation = next_generation(self._folder.generation, extras.generation if extras else 0)
        # After the checkpoint has proved that they fit
        tables = to_tables(config, "learner") | ({"actor": dict(actor)} if actor else {})
        save_settings(self._folder.config, tables)
        if not config.resume:
            self._run_log.truncate(0, -1)  # rows of a process that ended before its first checkpoint
        if group.size > 1:  # what the others begin with
            group.of_leader(str(self._generation).encode())
            group.of_leader(file.read_bytes() if file else b"")
        self._intake = new_intake(config, group, self._learner_state(), extras, self.training.obs_size)
        self._member = Member("learner", config, transport, metrics, self._generation, id=LEARNER_ID)
        self._reception = Reception(
            *(config, group, transport, self._member, metrics, self._history, self._intake),
            self.training.obs_size,
            clock,
        )
        self._members = self._reception.members
        identity = Identity(
            *(config.run, self._generation, contract_hash(task, config.network), self._training_hash),
            ranks=group.size,
        )
        self._broadcast = Broadcast(
            transport, self._member.keys, self.training, identity, stages, config.evaluated_weights
        )
        known = [str(account["actor"]) for account in extras.accounts] if extras else []
        self._registrar = Registrar(
            config, self._folder.config, transport, self._member, Places(known, self._clock())
        )
        self._has_nothing_left = self._has_ended = False
        self._warned = False
        self._is_mid_epoch = False  # also after an epoch that failed: its parameters are neither old nor new
        self._last: dict[str, float] = {}  # the newest epoch's figures, for heartbeats
        # Without it, a learner that waits for its first actor would seem to have no checkpoint since 1970.
        metrics.set("topspin_checkpoint_time_seconds", time.time())
        telemetry.begin(metrics)
        self._members.join()
        self._broadcast.publish_policy()
        self._broadcast.publish_stage()
        self._history.note(
            "start", **where(self.training, self._generation), waiting=lives(self._intake.waiting)
        )

    # ---- state

    @property
    def state(self) -> str:
        """State in the heartbeat: waiting, training or done."""
        return self._member.state

    @property
    def seconds(self) -> float:
        """Time since the first trained batch, through restarts [s]."""
        first = self._clocks.first_trained
        return self._clocks.resumed_seconds + (self._clocks.last_trained - first if first >= 0 else 0.0)

    @property
    def done(self) -> bool:
        """Whether the budget is spent, or a drain was requested."""
        clocks = self._clocks
        spent_s = self._clock() - clocks.first_trained if clocks.first_trained >= 0 else 0.0
        is_requested = self._member.is_draining or self._has_nothing_left
        return is_requested or bool(self._spent(spent_s + clocks.resumed_seconds))

    def _spent(self, seconds: float, slack_s: float = 0.0) -> str:
        """Return the limit that is reached after so many seconds of training, or ""."""
        config, progress = self._config, self.training.progress
        budget = Budget(config.curriculum.frames, config.frames, config.minutes)
        return budget.spent(progress.frames, seconds, slack_s)

    def ledger(self) -> Ledger:
        """Return the ledger of all actors together."""
        return self._intake.total()

    # ---- work

    def run(self, stop: Event) -> None:
        """Train until the budget is spent or ``stop`` is set; the run folder is complete afterwards."""
        config = self._config
        log.info(
            "%s endpoint=%s run=%s frames=%d of=%s; waiting for actors, start one with: python -m services.actor "
            "--run %s %s (and rallies with: python -m services.generator --run %s %s)",
            "listening" if config.mode == "hub" else "connected",
            config.endpoint,
            config.run,
            self.training.progress.frames,
            config.frames or config.curriculum.frames,
            *(config.run, self._link) * 2,
        )
        compute = self.training.compute
        log.info(
            "updates device=%s precision=%s threads=%d", compute.device, compute.precision, compute.threads
        )
        if config.resume and (spent := self._spent(self.seconds, ENDING_S)):
            log.warning(NOTHING_LEFT, spent, "")
            self._has_nothing_left = True
        saves = True
        try:
            while not self._has_ended:
                wait = self.step(stop.is_set())
                if wait > 0:
                    self._transport.wait(wait)
            self._member.state = "done"
        except Exception:
            # Half an epoch is no state to go on from, and the accounts of the other ranks, which end too, can't be had:
            # the newest checkpoint stays the last one
            saves = self._group.size == 1 and not self._is_mid_epoch
            raise
        finally:
            if saves:
                self.save(is_last=True)
            self._beat()
            self._run_log.close()
            self._member.leave()
            self._history.note("end", trained=self.ledger().trained, balance=self.ledger().balance)
            self._history.close()
        progress = self.training.progress
        log.info("stopped epoch=%d frames=%d stage=%d", progress.epoch, progress.frames, progress.stage)

    def step(self, is_stopping: bool = False) -> float:
        """Answer, train an epoch if a dataset is complete, and return how long to wait [s].

        Args:
            is_stopping: Whether a stop was requested.
        """
        self._serve()
        ends = is_stopping or self.done
        dataset, is_complete, self._has_ended = self._lockstep.turn(
            self._intake, self._clock(), ends, self._serve
        )
        if self._has_ended:
            return 0.0
        if is_complete:
            self._train(in_order(dataset))
        now = self._clock()
        if not is_complete:
            self._member.state = "waiting"
            self._warn_of_silence(now)
        if self._member.is_due(now):
            self._beat()
        if is_complete and self._lockstep.agrees(now >= self._clocks.next_checkpoint):
            self._clocks.next_checkpoint = now + self._config.checkpoint_interval_s
            self.save()
        return 0.0 if is_complete else IDLE_WAIT_S if self._group.size == 1 else TURN_WAIT_S

    def save(self, is_last: bool = False) -> None:
        """Write checkpoint and policy/latest; parameters that are not finite never replace good ones.

        Args:
            is_last: Whether this process trains no more. Then the checkpoint also keeps the rollouts that wait.

        Raises:
            NotSavedError: The last state can't be saved.
        """
        if not self.training.is_finite:
            log.error("not saved: parameters are not finite epoch=%d", self.training.progress.epoch)
            return
        extras = checkpoint.Extras(
            run=self._config.run,
            generation=self._generation,
            stage_log=[asdict(change) for change in self._broadcast.stages],
            trained_seconds=self.seconds,
            **self._lockstep.collected(self._intake, is_last),
        )
        self._keeper.save(extras, lives(self._intake.waiting) if is_last else [], is_last)

    # ---- training

    def _train(self, dataset: Sequence[Queued]) -> None:
        self._member.state = "training"
        started = self._clock()
        self._is_mid_epoch = True
        stats = self.training.run_epoch([entry.rollout for entry in dataset], self._serve)
        self._is_mid_epoch = False
        clocks, now = self._clocks, self._clock()
        if clocks.first_trained < 0:
            clocks.first_trained = now
            log.info("first batch trained seconds=%.1f frames=%d", now - clocks.born, stats.frames)
        if stats.stage_changed:
            self._broadcast.note_stage("curriculum")
        if stats.diverged:
            self._keeper.go_back(stats.diverged)
        lost = self._intake.finish_update(self._learner_state())
        self._history.note(
            "trained", **where(self.training, self._generation), rollouts=lives(dataset), lost=lives(lost)
        )
        self._broadcast.publish_policy()
        if stats.stage_changed:
            self._broadcast.publish_stage()
            clocks.next_checkpoint = now  # a restart must not lead back into the previous stage
        if not stats.update.finite:
            log.warning(
                "an update skipped gradient steps that were not finite epoch=%d", stats.progress.epoch
            )
        rate = stats.frames / max(now - (clocks.last_trained if clocks.last_trained >= 0 else started), 1e-9)
        clocks.last_trained = now
        self._run_log.append(row(stats, self.seconds, rate))
        self._last = telemetry.epoch_gauges(stats, rate)
        telemetry.measure_epoch(self._metrics, stats, rate, now - started)
        self._warned = False

    def _learner_state(self) -> LearnerState:
        return self.training.state_of(self._config.run, self._generation, self._training_hash)

    def _restore(self) -> tuple[Path, checkpoint.Extras]:
        """Load the newest whole checkpoint; return it, and what the service keeps in it."""
        file, extras = self._keeper.restore()
        self._clocks.resumed_seconds = extras.trained_seconds
        self._run_log.truncate(self.training.progress.epoch, self.training.progress.frames)
        return file, extras

    # ---- messages

    def _serve(self) -> None:
        """Answer waiting requests; also between gradient steps, so that no actor waits for an update."""
        now = self._clock()
        self._reception.serve(now)
        self._broadcast.answer()
        self._registrar.answer(self._members.actors, now)

    def _warn_of_silence(self, now: float) -> None:
        since = max(self._clocks.last_trained, self._clocks.born)
        if self._warned or now - since < self._config.silence_warning_s:
            return
        self._warned = True
        actors = self._members.roles.count("actor")
        if actors == 0:
            log.warning(
                "waiting for=actors seconds=%.0f; start one with: python -m services.actor --run %s %s",
                now - since,
                self._config.run,
                self._link,
            )
        else:
            log.warning(
                "waiting for=rollouts have=%d of=%d actors=%d with_another_contract=%d",
                self._lockstep.queued,
                self._dataset_rollouts,
                actors,
                len(self._intake.misfits),
            )

    # ---- numbers

    def _beat(self) -> None:
        self._intake.tidy(self._clock())
        ledger = self.ledger()
        telemetry.measure_state(self._metrics, ledger, self._intake, self._members.roles)
        is_alone = self._group.size == 1  # a group's sums are those of its last turn
        counters, gauges = telemetry.heartbeat(
            self.training.progress,
            self._config.curriculum.frames or 0,
            self.seconds,
            telemetry.fates(ledger) if is_alone else self._lockstep.fates,
            self._intake.queued if is_alone else self._lockstep.queued,
            self._last | {"misfits": len(self._intake.misfits)},
        )
        self._member.beat(counters, gauges)
