"""The actor's shell: takes policies and rallies in, plays, and sends rollouts until each has its verdict."""

import logging
import time
from collections import deque
from dataclasses import replace
from threading import Event

from common.comms.codec import DecodeError, decode, decode_one_of, encode
from common.comms.keys import Keys
from common.comms.messages import (
    ActorReport,
    Command,
    Control,
    ControlReply,
    PolicySnapshot,
    RallyBatch,
    RallyRequest,
    StageChange,
    Status,
    Verdict,
)
from common.comms.transport import Flow, NoReply, PendingReply, Reply, Transport
from common.errors import ReportedError
from common.metrics import Metrics
from common.policy.weights import PolicyError
from common.rally.draws import Stream, bits
from services.actor import outbox as box
from services.actor.config import ActorConfig
from services.actor.player import Player
from services.actor.rally_buffer import RallyBuffer, launch_fault

log = logging.getLogger(__name__)

IDLE_WAIT_S = 0.05
RALLY_BATCHES = 8  # that wait beside the ring until there is room for them
MOST_RANDOM = 0.05  # [-] share of launches in a block that may be random before the log says so
REPORT_INTERVAL_S = 0.25  # without credits: no grant can be lost for longer
ASK_AGAIN_S = 1.0  # for the policy
ASK_RALLIES_S = 2.0  # for one block
LAST_VERDICTS_S = 2.0  # at the end, for what is under way
GOODBYE_S = 2.0
LEARNER_ID = "0"


class NoRalliesError(ReportedError):
    """The generator that a reproducible run can't do without is missing."""


class _AskedToStop(Exception):  # noqa: N818 - not an error
    """A stop came while a rollout was played that can't be finished."""


class ActorService:
    """One actor.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Where its numbers go.
        incarnation: Of this life.
    """

    def __init__(self, config: ActorConfig, transport: Transport, metrics: Metrics, incarnation: int) -> None:
        self._config, self._transport, self._metrics = config, transport, metrics
        self._incarnation = incarnation
        self._keys = keys = Keys(config.run)
        self._dealt, self._runs_short = (0, 0), False  # random launches and rallies at the last block
        self._shard = config.index % config.shards
        seed = int(bits(config.seed, Stream.RESET, config.index)) >> 1
        self._buffer = RallyBuffer(config.envs, config.launch, config.env.noise, seed, self._refill)
        self._player = Player(
            config.env, config.network, self._buffer, config.envs, config.horizon, seed, launch=config.launch
        )
        self._outbox = box.Outbox(config.outbox)
        self._pending: dict[int, PendingReply] = {}
        self._report: PendingReply | None = None
        self._asked: PendingReply | None = None
        self._next_ask = self._next_report = self._next_status = 0.0
        self._may_have_missed = False  # a policy, while the link was down or the mailbox full
        self._policies = transport.subscribe(keys.policy(), capacity=1)
        self._stages = transport.subscribe(keys.stage(), capacity=64)
        asks = config.rallies == "ask"
        self._rallies = None if asks else transport.subscribe(keys.rally(self._shard), capacity=RALLY_BATCHES)
        self._batches: deque[RallyBatch] = deque()
        self._ready: float | None = None  # since when there is a policy
        self._block = 0
        self._stop = Event()
        self._control = transport.serve(keys.ctl("actor", config.id), capacity=16)
        self._alive = transport.declare_alive(keys.alive("actor", config.id, incarnation))
        self._reconnects = transport.reconnect_count
        self._paused = self._draining = False
        self._frames = 0
        self._idle_since: float | None = None
        self._warned = False
        self.state = "waiting"

    @property
    def counts(self) -> box.Counts:
        """The ledger of this life."""
        return self._outbox.counts

    @property
    def frames(self) -> int:
        """Control steps played, over all environments."""
        return self._frames

    @property
    def drained(self) -> bool:
        """Whether a drain was asked for and every rollout has its verdict."""
        return self._draining and not self._outbox.flights

    def step(self, now: float) -> float:
        """Do what is due, play one rollout if one is wanted, and return how long there is nothing to do [s]."""
        self._obey()
        self._take_policies(now)
        self._take_verdicts(now)
        self._outbox = box.expired(self._outbox, now)
        self._send(now)
        reason = self._idle_reason(now)
        if not reason:
            self._idle_since = None
            self.state = "playing"
            self._play(now)
            self._send(time.monotonic())
        else:
            self._wait_for(reason, now)
        if now >= self._next_status:
            self._next_status = now + self._config.status_interval_s
            self._publish_status()
        return IDLE_WAIT_S if reason else 0.0

    def run(self, stop: Event) -> None:
        """Work until ``stop`` is set or a drain is done, then say goodbye."""
        self._stop = stop
        try:
            while not stop.is_set() and not self.drained:
                wait = self.step(time.monotonic())
                if wait > 0:
                    self._transport.wait(wait)
        except _AskedToStop:
            log.info("stopped within a rollout, which nobody will see")
        self.leave()

    def leave(self) -> None:
        """Wait a moment for a verdict on every rollout, and tell the learner that nothing will follow."""
        now = time.monotonic()
        deadline = now + LAST_VERDICTS_S
        self._outbox = box.at_once(self._outbox, now)  # what waits for its next try has no later one
        while self._outbox.flights and now < deadline:
            self._send(now)
            self._transport.wait(IDLE_WAIT_S)
            now = time.monotonic()
            self._take_verdicts(now)
        pending = self._send_report(leaving=True, timeout_s=GOODBYE_S)
        if pending.wait() is NoReply.TIMEOUT:
            log.warning("the learner did not answer the goodbye")
        self._publish_status()
        self._alive.close()

    # ---- what to do

    def _idle_reason(self, now: float) -> str:
        snapshot = self._player.snapshot
        if self._paused:
            return "a resume"
        if self._draining:
            return "the last verdicts"
        if snapshot is None:
            return f"a policy from the learner on {self._keys.policy()}"
        self._ready = now if self._ready is None else self._ready
        is_patient = self._rallies is None or now - self._ready < self._config.rally_wait_s
        if (
            self._frames == 0 and is_patient and self._buffer.room > 0
        ):  # begin with a full stock of valid rallies
            self._refill()
            if self._buffer.room > 0:
                return f"rallies of shard {self._shard} from a generator"
        return box.idle_reason(self._outbox, snapshot.generation, snapshot.version)

    def _play(self, now: float) -> None:
        rollout = self._player.play(self._config.id, self._incarnation, self._outbox.next_sequence)
        played = time.monotonic()
        self._outbox = box.offer(self._outbox, encode(rollout), played)
        self._frames += rollout.rewards.size
        self._metrics.inc("topspin_frames_total", rollout.rewards.size)
        self._metrics.inc("topspin_episodes_total", len(rollout.episodes.outcome))
        self._metrics.inc("topspin_rollouts_published_total", 1.0)
        for phase, seconds in rollout.seconds.items():
            self._metrics.inc("topspin_phase_seconds_total", seconds, phase=phase)
        self._metrics.inc("topspin_phase_seconds_total", time.monotonic() - played, phase="encode")
        self._note_underruns()

    def _note_underruns(self) -> None:
        """Say when rallies begin to run out, and when there are enough again: random launches teach little."""
        counts = self._buffer.counts
        random_, dealt = counts.underruns - self._dealt[0], counts.consumed - self._dealt[1]
        self._dealt = (counts.underruns, counts.consumed)
        if not self._runs_short and random_ > MOST_RANDOM * (random_ + dealt):
            self._runs_short = True
            log.warning(
                "rallies run out random=%d of=%d launches; raise the generators' rate_hz, or add generators",
                random_,
                random_ + dealt,
            )
        elif self._runs_short and random_ == 0 and dealt > 0:
            self._runs_short = False
            log.info("rallies suffice again")

    def _wait_for(self, reason: str, now: float) -> None:
        self.state = "paused" if self._paused else "draining" if self._draining else "waiting"
        if self._idle_since is None:
            self._idle_since, self._warned = now, False
        if not self._warned and now - self._idle_since > self._config.silence_warning_s:
            self._warned = True
            log.warning("waiting for=%r seconds=%.0f", reason, now - self._idle_since)
        outcome = self._report.poll() if self._report else NoReply.TIMEOUT
        if outcome is not None and now >= self._next_report and not self._paused:
            self._next_report = now + REPORT_INTERVAL_S
            self._report = self._send_report(leaving=False, timeout_s=5.0)

    # ---- policies

    def _take_policies(self, now: float) -> None:
        for sample in self._policies.poll():
            self._adopt(sample.payload)
        for sample in self._stages.poll():
            try:
                change = decode(sample.payload, StageChange)
            except DecodeError as error:
                self._refused("stage", error)
                continue
            if self._player.snapshot is None or change.number > self._player.snapshot.stage_number:
                self._may_have_missed = True
        if self._transport.reconnect_count != self._reconnects:
            self._reconnects = self._transport.reconnect_count
            self._may_have_missed = True
        if self._asked is not None and (outcome := self._asked.poll()) is not None:
            self._asked = None
            if isinstance(outcome, Reply):
                self._may_have_missed = False
                self._adopt(outcome.payload)
        if self._asked is None and now >= self._next_ask and self._is_behind():
            self._next_ask = now + ASK_AGAIN_S
            self._asked = self._transport.request(self._keys.policy(), b"", 5.0, Flow.POLICY)

    def _is_behind(self) -> bool:
        """Return whether the learner is known to be ahead of the policy at hand."""
        snapshot = self._player.snapshot
        if snapshot is None:
            return True
        newest = (self._outbox.generation, self._outbox.credit_version)
        return (snapshot.generation, snapshot.version) < newest or self._may_have_missed

    def _adopt(self, payload: bytes) -> None:
        try:
            snapshot = decode(payload, PolicySnapshot)
            mine = self._player.snapshot
            if mine and (snapshot.generation, snapshot.version) <= (mine.generation, mine.version):
                return
            self._player.adopt(snapshot)
        except (DecodeError, PolicyError) as error:
            self._refused("policy", error)
            return
        self._next_report = 0.0  # a new version wants new rollouts: ask for its credits at once
        self._metrics.set("topspin_policy_version", snapshot.version)
        self._metrics.set("topspin_stage", snapshot.stage)
        if (
            mine is None
            or mine.stage_number != snapshot.stage_number
            or mine.generation != snapshot.generation
        ):
            log.info(
                "policy received generation=%d version=%d stage=%d",
                snapshot.generation,
                snapshot.version,
                snapshot.stage,
            )

    # ---- rollouts

    def _send(self, now: float) -> None:
        for flight in box.due(self._outbox, now):
            if flight.tries:
                self._metrics.inc("topspin_rollouts_retried_total", 1.0)
            self._pending[flight.sequence] = self._transport.request(
                self._keys.rollout(), flight.payload, self._config.outbox.request_timeout_s, Flow.ROLLOUT
            )
            self._metrics.inc("topspin_bytes_sent_total", len(flight.payload))
            self._outbox = box.sent(self._outbox, flight.sequence)

    def _take_verdicts(self, now: float) -> None:
        for sequence, pending in list(self._pending.items()):
            outcome = pending.poll()
            if outcome is None:
                continue
            del self._pending[sequence]
            verdict = self._verdict(outcome)
            if verdict is None:
                self._outbox = box.unanswered(self._outbox, sequence, now)
                continue
            before = self._outbox.counts
            self._outbox = box.answered(self._outbox, sequence, verdict, now)
            self._count(before, verdict)
        if self._report is not None and (outcome := self._report.poll()) is not None:
            self._report = None
            verdict = self._verdict(outcome)
            if verdict is not None:
                self._outbox = box.credited(self._outbox, verdict)

    def _verdict(self, outcome: Reply | NoReply) -> Verdict | None:
        if isinstance(outcome, NoReply):
            return None
        try:
            return decode(outcome.payload, Verdict)
        except DecodeError as error:
            self._refused("verdict", error)
            return None

    def _count(self, before: box.Counts, verdict: Verdict) -> None:
        after = self._outbox.counts
        if after.accepted > before.accepted:
            self._metrics.inc("topspin_rollouts_accepted_total", 1.0)
        elif sum(after.refused.values()) > sum(before.refused.values()):
            self._metrics.inc("topspin_rollouts_refused_total", 1.0, reason=verdict.first.value)
            log.warning("rollout refused kind=%s reason=%r", verdict.first.value, verdict.reason)

    def _send_report(self, leaving: bool, timeout_s: float) -> PendingReply:
        snapshot = self._player.snapshot
        report: ActorReport = box.report(
            self._outbox,
            run=self._config.run,
            actor=self._config.id,
            incarnation=self._incarnation,
            version=snapshot.version if snapshot else 0,
            leaving=leaving,
        )
        return self._transport.request(
            self._keys.ctl("learner", LEARNER_ID), encode(report), timeout_s, Flow.CONTROL
        )

    # ---- rallies

    def _refill(self) -> None:
        if self._rallies is None:
            self._ask_for_rallies()
            return
        while self._buffer.room > 0:
            if not self._batches:  # what nobody needs yet stays in the mailbox, where the newest wins
                self._batches.extend(filter(None, (self._batch(s.payload) for s in self._rallies.poll())))
            if not self._batches:
                return
            self._buffer.put(self._batches.popleft())

    def _batch(self, payload: bytes) -> RallyBatch | None:
        """Return the batch in a message, or None if it is of no use here."""
        try:
            batch = decode(payload, RallyBatch)
        except DecodeError as error:
            self._refused("rally", error)
            return None
        fault = launch_fault(batch)
        if (batch.preset, batch.noise) != (self._config.launch, self._config.env.noise):
            fault = f"{batch.preset}/{batch.noise}; allowed: {self._config.launch}/{self._config.env.noise}"
        if fault:
            self._refused("rally", f"generator={batch.source} {fault}")
            return None
        return batch

    def _ask_for_rallies(self) -> None:
        """Fetch the next block by index and wait for it: which rally is played when must not depend on timing."""
        key, request = (
            self._keys.rally(self._shard),
            encode(RallyRequest(shard=self._shard, block=self._block)),
        )
        deadline = time.monotonic() + self._config.rally_wait_s
        while not self._stop.is_set():
            outcome = self._transport.request(key, request, ASK_RALLIES_S, Flow.RALLY).wait()
            batch = self._batch(outcome.payload) if isinstance(outcome, Reply) else None
            if batch is not None and batch.block == self._block:
                # In this mode blocks are numbered by what was asked for, whoever answers.
                self._buffer.put(replace(batch, source="asked", incarnation=0, sequence=self._block))
                self._block += 1
                return
            if self._frames == 0 and not self._buffer.counts.consumed:
                return  # nothing is played yet: `step` asks again
            if time.monotonic() > deadline:
                raise NoRalliesError(
                    f"no rally block {self._block} of shard {self._shard} in {self._config.rally_wait_s:.0f} s, and "
                    "a reproducible run can't go on without: start a generator (python -m services.generator)"
                )
            self._transport.wait(IDLE_WAIT_S)
        raise _AskedToStop

    # ---- being a service

    def _obey(self) -> None:
        while (request := self._control.poll()) is not None:
            try:
                message = decode_one_of(request.payload, (Control,))
            except DecodeError as error:
                self._refused("control", error)
                request.refuse()
                continue
            command = message.command
            self._paused = command is Command.PAUSE or (self._paused and command is not Command.RESUME)
            self._draining |= command in (Command.DRAIN, Command.STOP)
            request.reply(encode(ControlReply(True, self.state, "")))

    def _refused(self, kind: str, reason: object) -> None:
        self._metrics.inc("topspin_messages_refused_total", 1.0, kind=kind)
        log.warning("message refused kind=%s reason=%s", kind, reason)

    def _publish_status(self) -> None:
        counts, rallies = self._outbox.counts, self._buffer.counts
        snapshot = self._player.snapshot
        m = self._metrics
        m.follow("topspin_reconnects_total", self._transport.reconnect_count)
        for name, mailbox in (("stage", self._stages), ("rally", self._rallies), ("control", self._control)):
            if mailbox is not None:
                m.follow("topspin_messages_dropped_total", mailbox.dropped, key=name)
        m.set("topspin_rollouts_in_flight", counts.in_flight)
        m.set("topspin_rally_buffer_depth", len(self._buffer))
        counters = {
            "frames": self._frames,
            "published": counts.published,
            "accepted": counts.accepted,
            "refused": sum(counts.refused.values()),
            "dropped": counts.dropped,
            "rallies_received": rallies.received,
            "rallies_consumed": rallies.consumed,
            "rallies_overflowed": rallies.overflowed,
            "rally_underruns": rallies.underruns,
            "rally_gaps": rallies.gaps,
        }
        m.follow("topspin_rallies_consumed_total", rallies.consumed)
        m.follow("topspin_rally_underruns_total", rallies.underruns)
        m.follow("topspin_rally_gaps_total", rallies.gaps)
        m.follow("topspin_rollouts_given_up_total", counts.dropped)
        status = Status(
            role="actor",
            id=self._config.id,
            incarnation=self._incarnation,
            time=time.time(),
            state=self.state,
            counters={name: float(value) for name, value in counters.items()},
            gauges={
                "in_flight": float(counts.in_flight),
                "buffer": float(len(self._buffer)),
                "version": float(snapshot.version if snapshot else -1),
                "stage": float(snapshot.stage if snapshot else 0),
            },
        )
        self._transport.publish(self._keys.status("actor", self._config.id), encode(status), Flow.STATUS)
