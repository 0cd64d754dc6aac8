"""The learner's shell: takes rollouts in, trains epochs, broadcasts policies and stage changes, keeps the run."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from threading import Event

from common.comms.codec import DecodeError, decode_one_of, encode
from common.comms.keys import Keys
from common.comms.messages import (
    AVERAGE,
    ActorReport,
    Command,
    Control,
    ControlReply,
    PolicySnapshot,
    Rollout,
    StageChange,
    StageLog,
    Status,
)
from common.comms.transport import Flow, Transport
from common.config import record, to_table
from common.env.robot import home_action
from common.env.teacher import teacher_of
from common.errors import ReportedError
from common.metrics import Metrics
from common.policy.actor_critic import ActorCritic
from common.policy.weights import Contract, contract_of, pack, save_policy, task_hash
from common.rally.reward import TERMS
from common.rally.trajectory import Outcome
from common.run_folder import RunFolder
from services.learner import checkpoint
from services.learner.arm import Arm
from services.learner.budget import ENDING_S, NOTHING_LEFT, Budget
from services.learner.config import LearnerConfig
from services.learner.guard import NOT_FINITE
from services.learner.intake import Intake
from services.learner.ledger import Ledger, Remembered
from services.learner.record import Record, row
from services.learner.training import EpochStats, Training
from services.learner.verdicts import Standing, open_rollout

log = logging.getLogger(__name__)

ROLLOUT_MAILBOX = 256  # above all rollouts that actors may have under way: a full one would turn them away
SERVED_AT_ONCE = 64  # messages looked at between two gradient steps
IDLE_WAIT_S = 0.05
LEARNER_ID = "0"


class RunExistsError(ReportedError):
    """A new run would overwrite an old one's checkpoints."""


class DivergedError(ReportedError):
    """Training has gone wrong for good."""


@dataclass(slots=True)
class Clocks:
    """Moments of the learner's life [s on its clock]."""

    born: float
    first_trained: float = -1.0
    last_trained: float = -1.0
    next_status: float = 0.0
    next_checkpoint: float = 0.0
    resumed_seconds: float = 0.0


class LearnerService:
    """The learner of one run.

    Args:
        config: Settings.
        transport: The hub, or a connection to one.
        metrics: Where its numbers go.
        clock: Seconds.
    """

    def __init__(
        self,
        config: LearnerConfig,
        transport: Transport,
        metrics: Metrics,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config, self._transport, self._metrics, self._clock = config, transport, metrics, clock
        self._folder = RunFolder.of(config.run, config.folder)
        if not config.resume and checkpoint.checkpoints(self._folder.checkpoints):
            raise RunExistsError(
                f"run {config.run!r} has checkpoints in {self._folder.checkpoints}: "
                "go on with --resume, or choose another --run"
            )
        # Raises where it couldn't teach: actors would end for it, and be started again for ever
        teacher_of(config.env)
        self._folder.create()
        self._record = Record(self._folder.metrics, self._folder.tensorboard)
        self.training = Training(
            config.ppo,
            config.network,
            config.curriculum,
            home_action(config.env.robot),
            config.seed,
            notice=max(1, config.intake.lag_aimed_at),
            observation=config.env.observation,
            guard=config.guard,
            teacher=config.env.teacher,
            arm=Arm(config.env.robot, config.env.control_rate_hz) if config.env.teacher.through_arm else None,
        )
        self._contract_hash = task_hash(config.network, config.env.model_dump(mode="json"), config.launch)
        self._generation = int(time.time())
        self._stages: list[StageChange] = []
        self._clocks = Clocks(clock())
        memory = self._restore() if config.resume else ()
        # As they now stand, once they have proved to fit; --resume says how this life began, and is none of the run.
        settings = to_table(config.model_copy(update={"resume": False}))
        record(self._folder.config, {"learner": settings})
        if not config.resume:
            self._record.truncate(0)  # of a life that ended before its first checkpoint
        self._intake = Intake(config.intake, self._standing(), memory)
        if not self._stages:
            self._note_stage("start")
        keys = self._keys = Keys(config.run)
        self._rollouts = transport.serve(keys.rollout(), capacity=ROLLOUT_MAILBOX)
        self._control = transport.serve(keys.ctl("learner", LEARNER_ID), capacity=ROLLOUT_MAILBOX)
        self._policies = transport.serve(keys.policy(), capacity=ROLLOUT_MAILBOX)
        self._stage_log = transport.serve(keys.stage(), capacity=ROLLOUT_MAILBOX)
        self._members = transport.watch_alive(keys.every_alive())
        self._alive: set[tuple[str, str, int]] = set()
        self._token = transport.declare_alive(keys.alive("learner", LEARNER_ID, self._generation))
        self._paused = self._stopping = False
        self._warned = False
        self._blob = self._average = b""
        self._last: dict[str, float] = {}  # the newest epoch's figures, for heartbeats
        self.state = "waiting"
        # Or one that waits for its first actor would have been without a checkpoint since 1970.
        metrics.set("topspin_checkpoint_time_seconds", time.time())
        self._publish_policy()
        self._transport.publish(keys.stage(), encode(self._stages[-1]), Flow.STAGE)

    # ---- what others may ask

    @property
    def seconds(self) -> float:
        """Time since the first trained batch, through restarts [s]."""
        first = self._clocks.first_trained
        return self._clocks.resumed_seconds + (self._clocks.last_trained - first if first >= 0 else 0.0)

    @property
    def done(self) -> bool:
        """Whether the budget is spent, or a stop was asked for."""
        clocks = self._clocks
        spent_s = self._clock() - clocks.first_trained if clocks.first_trained >= 0 else 0.0
        return self._stopping or bool(self._spent(spent_s + clocks.resumed_seconds))

    def _spent(self, seconds: float, slack_s: float = 0.0) -> str:
        """Return the limit that is reached after so many seconds of training, or ""."""
        config, progress = self._config, self.training.progress
        budget = Budget(config.curriculum.epochs, config.frames, config.minutes)
        return budget.spent(progress.epoch, progress.frames, seconds, slack_s)

    def ledger(self) -> Ledger:
        """Return the account of all actors together."""
        return sum(self._intake.ledgers().values(), Ledger())

    # ---- work

    def run(self, stop: Event) -> None:
        """Train until the budget is spent or ``stop`` is set; the run folder is whole afterwards."""
        config = self._config
        log.info(
            "listening endpoint=%s run=%s epoch=%d of=%d; waiting for actors, start one with: python -m services.actor "
            "--run %s --endpoint %s (and rallies with: python -m services.generator --run %s --endpoint %s)",
            config.endpoint,
            config.run,
            self.training.progress.epoch,
            config.curriculum.epochs,
            *(config.run, config.endpoint) * 2,
        )
        if config.resume and (spent := self._spent(self.seconds, ENDING_S)):
            log.warning(NOTHING_LEFT, spent, "")
            self._stopping = True
        try:
            while not stop.is_set() and not self.done:
                wait = self.step()
                if wait > 0:
                    self._transport.wait(wait)
            self.state = "done"
        finally:
            self.save()
            self._publish_status()
            self._record.close()
            self._token.close()
        progress = self.training.progress
        log.info("stopped epoch=%d frames=%d stage=%d", progress.epoch, progress.frames, progress.stage)

    def step(self) -> float:
        """Answer, train an epoch if a dataset is there, and return how long there is nothing to do [s]."""
        self._serve()
        trained = False
        if not self._paused:
            dataset = self._intake.take_dataset()
            if dataset:
                # by number, not by arrival: so the bits of a run with one actor don't hang on the network
                ordered = sorted(dataset, key=lambda entry: (entry.header.actor, entry.header.sequence))
                self._train([entry.rollout for entry in ordered])
                trained = True
        now = self._clock()
        if not trained:
            self.state = "paused" if self._paused else "waiting"
            self._warn_of_silence(now)
        if now >= self._clocks.next_status:
            self._clocks.next_status = now + self._config.status_interval_s
            self._publish_status()
        if trained and now >= self._clocks.next_checkpoint:
            self._clocks.next_checkpoint = now + self._config.checkpoint_interval_s
            self.save()
        return 0.0 if trained else IDLE_WAIT_S

    def save(self) -> None:
        """Write checkpoint and policy/latest; what is ruined doesn't take the place of what was good."""
        if not self.training.is_finite:
            log.error("not saved: parameters are not finite epoch=%d", self.training.progress.epoch)
            return
        extras = checkpoint.Extras(
            run=self._config.run,
            generation=self._generation,
            stage_log=[asdict(change) for change in self._stages],
            memory=[entry.to_json() for entry in self._intake.memory()],
            trained_seconds=self.seconds,
        )
        path = checkpoint.save(self._folder.checkpoints, self.training, extras)
        if self.training.progress.is_worth_going_back_to:
            checkpoint.keep(path, self._folder.checkpoints / checkpoint.GOOD)
        save_policy(
            self._folder.latest_policy, self.training.average, self.training.obs_moments, self._contract()
        )
        self._metrics.set("topspin_checkpoint_time_seconds", time.time())
        log.debug("checkpoint written file=%s", path)

    # ---- training

    def _train(self, rollouts: Sequence[Rollout]) -> None:
        self.state = "training"
        started = self._clock()
        stats = self.training.run_epoch(rollouts, self._serve)
        clocks, now = self._clocks, self._clock()
        if clocks.first_trained < 0:
            clocks.first_trained = now
            log.info("first batch trained seconds=%.1f frames=%d", now - clocks.born, stats.frames)
        if stats.stage_changed:
            self._note_stage("curriculum")
        if stats.diverged:
            self._go_back(stats.diverged)
        self._intake.finish_update(self._standing())
        self._publish_policy()
        if stats.stage_changed:
            self._transport.publish(self._keys.stage(), encode(self._stages[-1]), Flow.STAGE)
            clocks.next_checkpoint = now  # a restart must not lead back into the stage before
        if not stats.update.finite:
            log.warning(
                "an update skipped gradient steps that were not finite epoch=%d", stats.progress.epoch
            )
        rate = stats.frames / max(now - (clocks.last_trained if clocks.last_trained >= 0 else started), 1e-9)
        clocks.last_trained = now
        self._record.append(row(stats, self.seconds, rate))
        self._measure(stats, rate, now - started)
        self._warned = False

    def _go_back(self, reason: str) -> None:
        """Return to the last good checkpoint, if there is one."""
        good = checkpoint.checkpoints(self._folder.checkpoints / checkpoint.GOOD)
        if not good:
            if reason == NOT_FINITE:
                raise DivergedError(
                    f"training has diverged: {reason}, and there is no good checkpoint to go back to; "
                    "try a lower --ppo.learning-rate-max"
                )
            self.training.forget_health()
            log.warning("training has diverged reason=%r; no good checkpoint yet, going on", reason)
            return
        path = good[-1]
        self.training.go_back(lambda training: checkpoint.restore(path, training))
        self._metrics.inc("topspin_rollbacks_total")
        log.warning("training has diverged reason=%r; went back to file=%s", reason, path)

    def _note_stage(self, reason: str) -> None:
        progress = self.training.progress
        change = StageChange(
            run=self._config.run,
            generation=self._generation,
            number=progress.stage_number,
            stage=progress.stage,
            frames=progress.frames,
            epoch=progress.epoch,
            reason=reason,
        )
        self._stages.append(change)
        log.info(
            "stage number=%d stage=%d frames=%d reason=%s", change.number, change.stage, change.frames, reason
        )

    def _standing(self) -> Standing:
        progress = self.training.progress
        return Standing(
            run=self._config.run,
            generation=self._generation,
            version=progress.version,
            stage_number=progress.stage_number,
            stage=progress.stage,
            contract_hash=self._contract_hash,
            datasets_left=self.training.datasets_left,
        )

    def _restore(self) -> tuple[Remembered, ...]:
        file = checkpoint.newest(self._folder.checkpoints)
        extras = checkpoint.restore(file, self.training)
        # Actors may still hold policies of the learner before: theirs must not look newer than ours.
        self._generation = max(self._generation, extras.generation + 1)
        self._stages = [StageChange(**change) for change in extras.stage_log]
        self._clocks.resumed_seconds = extras.trained_seconds
        self._record.truncate(self.training.progress.epoch)
        log.info(
            "resumed file=%s epoch=%d frames=%d",
            file,
            self.training.progress.epoch,
            self.training.progress.frames,
        )
        return tuple(Remembered.from_json(values) for values in extras.memory)

    # ---- talking

    def _snapshot(self, network: ActorCritic) -> bytes:
        """Return the newest version with the weights of ``network``, encoded."""
        training, progress = self.training, self.training.progress
        return encode(
            PolicySnapshot(
                run=self._config.run,
                generation=self._generation,
                version=progress.version,
                stage_number=progress.stage_number,
                stage=progress.stage,
                epoch=progress.epoch,
                frames=progress.frames,
                contract_hash=self._contract_hash,
                weights=pack(network),
                obs_mean=training.obs_moments.mean,
                obs_var=training.obs_moments.var,
                obs_count=training.obs_moments.count,
            )
        )

    def _publish_policy(self) -> None:
        self._blob = self._snapshot(self.training.network)
        self._average = b""  # made when somebody asks
        self._transport.publish(self._keys.policy(), self._blob, Flow.POLICY)

    def _averaged(self) -> bytes:
        """Return the newest version with the running mean of the weights."""
        if not self._average:
            self._average = self._snapshot(self.training.average)
        return self._average

    def _serve(self) -> None:
        """Answer what waits; also between gradient steps, so that no actor waits for an update."""
        now = self._clock()
        for event in self._members.poll():
            try:
                member = self._keys.member(event.key)
            except ValueError as error:  # KeyPartError, or digits that are no number
                self._refused("alive", error)
                continue
            (self._alive.add if event.alive else self._alive.discard)(
                (member.role, member.id, member.incarnation)
            )
            if member.role == "actor":
                (self._intake.seen if event.alive else self._intake.gone)(member.id, member.incarnation)
        for _ in range(SERVED_AT_ONCE):
            request = self._rollouts.poll()
            if request is None:
                break
            self._metrics.inc("topspin_bytes_received_total", len(request.payload))
            opened = open_rollout(
                request.payload, self._config.max_message_mib * 2**20, self.training.obs_size
            )
            if opened is None:
                self._refused("rollout", "unreadable")
                verdict = self._intake.unreadable("not readable as a rollout of this release")
            else:
                verdict = self._intake.arrive(*opened, now)
                if opened[0].fault:
                    self._refused("rollout", f"actor={opened[0].actor} {opened[0].fault}")
            self._metrics.inc("topspin_rollouts_received_total", 1.0, verdict=verdict.kind.value)
            request.reply(encode(verdict))
        while (request := self._control.poll()) is not None:
            try:
                message = decode_one_of(request.payload, (ActorReport, Control))
            except DecodeError as error:
                self._refused("control", error)
                request.refuse()
                continue
            if isinstance(message, ActorReport):
                request.reply(encode(self._intake.report(message, now)))
                continue
            self._paused = message.command is Command.PAUSE or (
                self._paused and message.command is not Command.RESUME
            )
            self._stopping |= message.command in (Command.STOP, Command.DRAIN)
            request.reply(encode(ControlReply(True, self.state, "")))
        while (request := self._policies.poll()) is not None:
            request.reply(self._averaged() if request.payload == AVERAGE else self._blob)
        while (request := self._stage_log.poll()) is not None:
            request.reply(encode(StageLog(tuple(self._stages))))

    def _refused(self, kind: str, reason: object) -> None:
        self._metrics.inc("topspin_messages_refused_total", 1.0, kind=kind)
        log.warning("message refused kind=%s reason=%s", kind, reason)

    def _warn_of_silence(self, now: float) -> None:
        since = max(self._clocks.last_trained, self._clocks.born)
        if self._warned or now - since < self._config.silence_warning_s:
            return
        self._warned = True
        actors = sum(role == "actor" for role, _, _ in self._alive)
        if actors == 0:
            log.warning(
                "waiting for=actors seconds=%.0f; start one with: python -m services.actor --run %s --endpoint %s",
                now - since,
                self._config.run,
                self._config.endpoint,
            )
        else:
            log.warning(
                "waiting for=rollouts have=%d of=%d actors=%d",
                self._intake.queued,
                self._config.intake.dataset_rollouts,
                actors,
            )

    # ---- numbers

    def _contract(self) -> Contract:
        config, progress = self._config, self.training.progress
        return contract_of(
            config.env,
            config.network,
            config.launch,
            run=config.run,
            generation=self._generation,
            version=progress.version,
            stage=progress.stage,
            frames=progress.frames,
        )

    def _measure(self, stats: EpochStats, rate: float, update_s: float) -> None:
        m, play, update, progress = self._metrics, stats.play, stats.update, stats.progress
        m.inc("topspin_frames_total", stats.frames)
        m.inc("topspin_episodes_total", int(play.outcomes.sum()))
        m.inc("topspin_phase_seconds_total", update_s, phase="update")
        m.observe("topspin_update_seconds", update_s)
        for outcome in Outcome:
            if outcome is not Outcome.NONE and play.outcomes[outcome]:
                m.inc("topspin_outcomes_total", int(play.outcomes[outcome]), outcome=outcome.name.lower())
        for name, value in {
            "topspin_frames_per_second": rate,
            "topspin_catch_rate": play.catch_rate,
            "topspin_over_rate": play.over_rate,
            "topspin_return_rate": play.return_rate,
            "topspin_target_error_meters": play.target_error,
            "topspin_episode_reward": play.mean_return,
            "topspin_policy_version": progress.version,
            "topspin_policy_lag": stats.lag,
            "topspin_stage": progress.stage,
            "topspin_epoch": progress.epoch,
            "topspin_learning_rate": update.learning_rate,
            "topspin_kl": update.kl,
            "topspin_clip_fraction": update.clip_fraction,
            "topspin_entropy": update.entropy,
            "topspin_policy_loss": update.policy_loss,
            "topspin_correction_loss": update.correction_loss,
            "topspin_value_loss": update.value_loss,
            "topspin_explained_variance": update.explained_variance,
            "topspin_gradient_norm": update.gradient_norm,
        }.items():
            m.set(name, value)
        self._last = {
            "frames_per_s": rate,
            "catch_rate": play.catch_rate,
            "return_rate": play.return_rate,
            "target_error": play.target_error,
            "reward": play.mean_return,
            "lag": stats.lag,
            "kl": update.kl,
            "learning_rate": update.learning_rate,
            "explained_variance": update.explained_variance,
        }
        for name, value in zip(TERMS, play.reward_terms, strict=True):
            m.set("topspin_reward_per_frame", float(value), term=name)

    def _publish_status(self) -> None:
        progress, ledger = self.training.progress, self.ledger()
        fates = {
            "published": ledger.published,
            "trained": ledger.trained,
            "refused": sum(ledger.refused.values()),
            "dropped": ledger.dropped,
            "in_flight": ledger.in_flight,
            "lost": ledger.lost,
        }
        for fate, count in fates.items():
            self._metrics.set("topspin_ledger_rollouts", count, fate=fate)
        self._metrics.follow("topspin_reconnects_total", self._transport.reconnect_count)
        for name, mailbox in (("rollout", self._rollouts), ("control", self._control)):
            self._metrics.follow("topspin_messages_dropped_total", mailbox.dropped, key=name)
        self._metrics.set("topspin_queue_depth", self._intake.queued)
        self._metrics.set("topspin_rollout_gaps", self._intake.gaps())
        for role in ("generator", "actor", "evaluator"):
            self._metrics.set("topspin_alive", sum(r == role for r, _, _ in self._alive), role=role)
        gauges = {
            "epoch": progress.epoch,
            "epochs": self._config.curriculum.epochs,
            "version": progress.version,
            "stage": progress.stage,
            "queued": self._intake.queued,
            "seconds": self.seconds,
            **self._last,
        }
        status = Status(
            role="learner",
            id=LEARNER_ID,
            incarnation=self._generation,
            time=time.time(),
            state=self.state,
            counters={"frames": float(progress.frames)}
            | {name: float(count) for name, count in fates.items()},
            gauges={name: float(value) for name, value in gauges.items() if not math.isnan(value)},
        )
        self._transport.publish(self._keys.status("learner", LEARNER_ID), encode(status), Flow.STATUS)
