"""The actor's shell: receives policies and rallies, plays, and sends rollouts until each has its verdict."""

import logging
import os
import time
from threading import Event
from typing import Final

from common.comms.codec import DecodeError, decode, encode
from common.comms.keys import rank_of
from common.comms.messages import (
    ActorReport,
    PolicySnapshot,
    StageChange,
    Verdict,
    VerdictKind,
)
from common.comms.transport import Flow, NoReply, PendingReply, Reply, Transport
from common.policy.contract import PolicyError
from common.service.history import History
from common.service.member import LEARNER_ID, Member
from common.service.metrics import Metrics
from common.task.counter_rng import Stream, bits
from services.actor import outbox as box
from services.actor.config import ActorConfig
from services.actor.following import Following, adopted, no_learner, noted, objection
from services.actor.player import Player
from services.actor.rally_buffer import RallyBuffer
from services.actor.rally_feed import RallyFeed, StopRequested

log = logging.getLogger(__name__)

IDLE_WAIT_S = 0.05
MOST_REASONS: Final = 16  # of waiting, that the log names while an actor is idle
REPORT_INTERVAL_S = 0.25  # while without credits, until the learner sets another: a lost grant is repeated
ASK_AGAIN_S = 1.0  # pause between requests for the policy
LAST_VERDICTS_S = 2.0  # wait at the end for rollouts in flight
LAST_REPORT_S = 2.0
REFUSALS: Final = frozenset(VerdictKind) - {
    *(VerdictKind.ACCEPTED, VerdictKind.DUPLICATE, VerdictKind.BUSY, VerdictKind.CREDITS),
}


class ActorService:
    """One actor.

    Args:
        config: Settings.
        transport: Connection to the hub.
        metrics: Receives the service's numbers.
        incarnation: Number of this life of the service.
    """

    def __init__(self, config: ActorConfig, transport: Transport, metrics: Metrics, incarnation: int) -> None:
        self._config, self._transport, self._metrics = config, transport, metrics
        self._member = Member("actor", config, transport, metrics, incarnation)
        self._history = History(config.history, f"actor-{config.id}")
        self._history.note("start", actor=config.id, incarnation=incarnation, process=os.getpid())
        self._keys = keys = self._member.keys
        self._stop = Event()
        self._feed = RallyFeed(config, transport, self._member, self._is_stopping)
        seed = int(bits(config.seed, Stream.RESET, config.number)) >> 1
        envs = config.env_count
        self._buffer = RallyBuffer(envs, config.task, seed, self._refill)
        self._player = Player(
            config.task,
            config.experience,
            config.network,
            self._buffer,
            envs,
            config.horizon,
            seed,
            note=self._buffer.note,
        )
        self._outbox = box.Outbox(config.outbox)
        self._pending: dict[int, PendingReply] = {}
        self._report: PendingReply | None = None
        self._asked: PendingReply | None = None
        self._next_ask = self._next_report = 0.0
        self._report_after_s = REPORT_INTERVAL_S
        self._known_credits = (0, 0, 0)  # generation, limit and version of the credits at the last report
        self._reported = (0, 0)  # generation and version of the policy in the last report
        self._following = Following()
        self._is_doubted = False  # whether the policy is not the learner's, though it has its generation
        self._misfit = ""  # why the learner's policy, or this actor's contract, is refused
        self._may_have_missed = False  # a policy may be missed while the link is down or the mailbox is full
        self._policies = transport.subscribe(keys.policy(), capacity=1)
        self._stages = transport.subscribe(keys.stage(), capacity=64)
        self._member.watch("stage", self._stages)
        self._learners = transport.watch_alive(keys.every_life_of("learner", LEARNER_ID))
        self._rank: int | None = None  # of the learner that takes this actor's rollouts
        self._ready: float | None = None  # [s] time of the first policy
        self._reconnects = transport.reconnect_count
        self._frames = 0
        self._rally_gaps = 0  # batches that were lost on their way
        self._idle_since: float | None = None
        self._told: set[str] = set()  # what it waits for, said since it is idle
        for kind in REFUSALS:  # from nothing to 1 would be no rise for Prometheus
            metrics.inc("topspin_rollouts_refused_total", 0.0, reason=kind.value)
        self._member.join()

    @property
    def state(self) -> str:
        """State in the heartbeat: waiting, playing or draining."""
        return self._member.state

    @property
    def counts(self) -> box.Counts:
        """The actor's side of the ledger."""
        return self._outbox.counts

    @property
    def frames(self) -> int:
        """Control steps played, over all environments."""
        return self._frames

    @property
    def drained(self) -> bool:
        """Whether a drain was requested and every rollout has its verdict."""
        return self._member.is_draining and not self._outbox.flights

    def step(self, now: float) -> float:
        """Do what is due, play one rollout if the learner needs one, and return how long to wait [s]."""
        self._member.answer_control()
        self._member.note_link(now)
        self._note_learners()
        self._take_policies(now)
        self._take_verdicts(now)
        self._drop_old(now)
        self._send(now)
        reason = self._idle_reason(now)
        if not reason:
            self._idle_since = None
            self._member.state = "playing"
            self._play(now)
            self._send(time.monotonic())
        else:
            self._wait_for(reason, now)
        if self._member.is_due(now):
            self._beat()
        return IDLE_WAIT_S if reason else 0.0

    def run(self, stop: Event) -> None:
        """Work until ``stop`` is set or a drain is done, then send the last report."""
        self._stop = stop
        try:
            while not stop.is_set() and not self.drained:
                wait = self.step(time.monotonic())
                if wait > 0:
                    self._transport.wait(wait)
        except StopRequested:
            log.info("stopped within a rollout, which is not sent")
        self.leave()

    def leave(self) -> None:
        """Wait up to 2 s for a verdict on every rollout, and report to the learner that no more rollouts follow."""
        now = time.monotonic()
        deadline = now + LAST_VERDICTS_S
        self._outbox = box.at_once(self._outbox, now)  # a rollout that waits for its next try is sent now
        while self._outbox.flights and now < deadline:
            self._send(now)
            self._transport.wait(IDLE_WAIT_S)
            now = time.monotonic()
            self._note_learners()
            self._take_verdicts(now)
        if self._rank is not None:
            pending = self._send_report(leaving=True, timeout_s=LAST_REPORT_S)
            if pending.wait() is NoReply.TIMEOUT:
                log.warning("the learner did not answer the last report")
        self._beat()
        self._member.leave()
        self._history.note("end", in_flight=[flight.sequence for flight in self._outbox.flights])
        self._history.close()

    # ---- what to do

    def _idle_reason(self, now: float) -> str:
        snapshot = self._player.snapshot
        if self._member.is_draining:
            return "the last verdicts"
        if not self._transport.connected:
            return f"the link to the hub at {self._config.endpoint}"
        if not self._following.standing:
            return no_learner(self._config.run, bool(self._config.tls))
        if snapshot is None:
            return self._misfit or f"a policy from the learner on {self._keys.policy()}"
        self._ready = now if self._ready is None else self._ready
        is_patient = self._feed.asks or now - self._ready < self._config.rally_wait_s
        if (
            self._frames == 0 and is_patient and self._buffer.room > 0
        ):  # start with a full stock of valid rallies
            self._refill()
            if self._buffer.room > 0:
                return f"rallies of shard {self._feed.shard} from a generator"
        reason = box.idle_reason(self._outbox, snapshot.generation, snapshot.version)
        return (self._misfit or reason) if reason else ""

    def _play(self, now: float) -> None:
        rollout = self._player.play(self._config.id, self._member.incarnation, self._outbox.next_sequence)
        played = time.monotonic()
        self._history.note(
            "played", number=rollout.sequence, generation=rollout.generation, version=rollout.version
        )
        self._outbox = box.offer(self._outbox, encode(rollout), played)
        self._frames += rollout.rewards.size
        self._metrics.inc("topspin_frames_total", rollout.rewards.size)
        self._metrics.inc("topspin_episodes_total", len(rollout.episodes.outcome))
        self._metrics.inc("topspin_rollouts_published_total", 1.0)
        for phase, seconds in rollout.seconds.items():
            self._metrics.inc("topspin_phase_seconds_total", seconds, phase=phase)
        self._metrics.inc("topspin_phase_seconds_total", time.monotonic() - played, phase="encode")
        self._feed.note_underruns(self._buffer)

    def _is_stopping(self) -> bool:
        return self._stop.is_set()

    def _refill(self) -> None:
        self._feed.refill(self._buffer)

    def _wait_for(self, reason: str, now: float) -> None:
        self._member.state = "draining" if self._member.is_draining else "waiting"
        if self._idle_since is None:
            self._idle_since = now
            self._told.clear()
        is_news = reason not in self._told and len(self._told) < MOST_REASONS
        if is_news and now - self._idle_since > self._config.silence_warning_s:
            self._told.add(reason)
            log.warning("waiting for=%r seconds=%.0f", reason, now - self._idle_since)
        outcome = self._report.poll() if self._report else NoReply.TIMEOUT
        if outcome is not None and now >= self._next_report and self._rank is not None:
            self._next_report = now + self._report_after_s
            self._report = self._send_report(leaving=False, timeout_s=5.0)

    # ---- policies

    def _note_learners(self) -> None:
        """Record which learners live."""
        for event in self._learners.poll():
            try:
                generation = self._keys.member(event.key).incarnation
            except ValueError as error:  # KeyPartError, or digits that are no number
                self._member.refuse("alive", error)
                continue
            self._following = noted(self._following, generation, event.alive)
            if event.alive:
                log.info("learner found generation=%d", generation)
                self._may_have_missed = True
                self._next_report = 0.0
            else:
                log.warning("learner gone generation=%d", generation)

    def _take_policies(self, now: float) -> None:
        for sample in self._policies.poll():
            self._adopt(sample.payload)
        for sample in self._stages.poll():
            try:
                change = decode(sample.payload, StageChange)
            except DecodeError as error:
                self._member.refuse("stage", error)
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
                self._adopt(outcome.payload, is_answer=True)
        if self._asked is None and now >= self._next_ask and self._is_behind():
            self._next_ask = now + ASK_AGAIN_S
            self._asked = self._transport.request(self._keys.policy(), b"", 5.0, Flow.POLICY)

    def _is_behind(self) -> bool:
        """Return whether the learner is known to have another policy."""
        snapshot = self._player.snapshot
        if snapshot is None or self._may_have_missed or self._is_doubted:
            return True
        if self._outbox.generation not in (0, snapshot.generation):
            return True
        return self._outbox.generation != 0 and snapshot.version < self._outbox.credit_version

    def _adopt(self, payload: bytes, is_answer: bool = False) -> None:
        """Play the policy in a message if it is a newer one of the followed learner.

        Args:
            payload: The message.
            is_answer: Whether the learner answered with it. Then it may also replace one that is doubted.
        """
        mine = self._player.snapshot
        try:
            snapshot = decode(payload, PolicySnapshot)
            may_go_back = is_answer and self._is_doubted
            if (
                mine is not None
                and snapshot.generation == mine.generation
                and snapshot.version <= mine.version
                and not may_go_back
            ):
                return
            if fault := objection(self._following, snapshot.generation):
                self._member.refuse("policy", fault)
                return
            self._rank = rank_of(self._config.id, snapshot.ranks)
            self._player.adopt(snapshot)
        except (DecodeError, PolicyError) as error:
            self._member.refuse("policy", error)
            if isinstance(error, PolicyError) and mine is None:
                self._misfit = f"a policy that it can play: {error}"
            return
        self._misfit, self._is_doubted = "", False
        self._following = adopted(self._following, snapshot.generation)
        # The learner needs new rollouts of a new version: report at once to get credits
        self._next_report = 0.0
        self._history.note(
            "policy",
            generation=snapshot.generation,
            version=snapshot.version,
            stage_number=snapshot.stage_number,
        )
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
            self._history.note("sent", number=flight.sequence, tries=flight.tries + 1)
            self._pending[flight.sequence] = self._transport.request(
                self._keys.rollout(self._config.id, self._rank or 0),
                flight.payload,
                self._config.outbox.request_timeout_s,
                Flow.ROLLOUT,
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
            self._count(sequence, before, verdict)
        if self._report is not None and (outcome := self._report.poll()) is not None:
            self._report = None
            verdict = self._verdict(outcome)
            if verdict is not None:
                generation, limit, version = self._known_credits
                known = (limit, version) if generation == verdict.generation else (0, 0)
                self._outbox = box.credited(self._outbox, verdict, known)
                self._heed(verdict)

    def _heed(self, verdict: Verdict) -> None:
        """Take what the answer to a report says about this actor."""
        self._report_after_s = verdict.report_after_s
        generation, version = self._reported
        if verdict.generation == generation and verdict.version < version and not self._is_doubted:
            self._is_doubted = True
            log.warning(
                "policy version=%d is not from the learner, whose newest is %d; asking the learner for it",
                version,
                verdict.version,
            )
        is_misfit = verdict.kind in (VerdictKind.WRONG_CONTRACT, VerdictKind.WRONG_RUN)
        self._misfit = f"a learner of its own contract: {verdict.reason}" if is_misfit else ""

    def _verdict(self, outcome: Reply | NoReply) -> Verdict | None:
        if isinstance(outcome, NoReply):
            return None
        try:
            verdict = decode(outcome.payload, Verdict)
            if fault := objection(self._following, verdict.generation):
                self._member.refuse("verdict", fault)
                return None
            return verdict
        except DecodeError as error:
            self._member.refuse("verdict", error)
            return None

    def _drop_old(self, now: float) -> None:
        before = len(self._outbox.dropped)
        self._outbox = box.expired(self._outbox, now)
        for sequence in self._outbox.dropped[before:]:
            self._history.note("dropped", number=sequence)

    def _count(self, sequence: int, before: box.Counts, verdict: Verdict) -> None:
        after = self._outbox.counts
        is_accepted = after.accepted > before.accepted
        is_refused = sum(after.refused.values()) > sum(before.refused.values())
        if is_accepted or is_refused:
            self._history.note(
                "verdict", number=sequence, kind=verdict.first.value, generation=verdict.generation
            )
        if is_accepted:
            self._metrics.inc("topspin_rollouts_accepted_total", 1.0)
        elif is_refused:
            self._metrics.inc("topspin_rollouts_refused_total", 1.0, reason=verdict.first.value)
            log.warning("rollout refused kind=%s reason=%r", verdict.first.value, verdict.reason)

    def _send_report(self, leaving: bool, timeout_s: float) -> PendingReply:
        snapshot = self._player.snapshot
        report: ActorReport = box.report(
            self._outbox,
            run=self._config.run,
            actor=self._config.id,
            incarnation=self._member.incarnation,
            version=snapshot.version if snapshot else 0,
            training_hash=self._player.training_hash,
            leaving=leaving,
        )
        self._reported = (snapshot.generation, snapshot.version) if snapshot else (0, 0)
        outbox = self._outbox
        self._known_credits = (outbox.generation, outbox.credit_limit, outbox.credit_version)
        return self._transport.request(
            self._keys.report(self._config.id, self._rank or 0), encode(report), timeout_s, Flow.CONTROL
        )

    # ---- numbers

    def _beat(self) -> None:
        counts, rallies = self._outbox.counts, self._buffer.counts
        snapshot = self._player.snapshot
        m = self._metrics
        m.set("topspin_rollouts_in_flight", counts.in_flight)
        m.set("topspin_rally_buffer_depth", len(self._buffer))
        m.follow("topspin_rallies_consumed_total", rallies.consumed)
        m.follow("topspin_rally_underruns_total", rallies.underruns)
        # A batch that this actor's own mailbox let go is seen as a gap later
        self._rally_gaps = max(self._rally_gaps, rallies.gaps - self._feed.unneeded)
        m.follow("topspin_rally_gaps_total", self._rally_gaps)
        m.follow("topspin_rollouts_given_up_total", counts.dropped)
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
            "rally_gaps": self._rally_gaps,
        }
        gauges = {
            "in_flight": counts.in_flight,
            "buffer": len(self._buffer),
            "version": snapshot.version if snapshot else -1,
            "stage": snapshot.stage if snapshot else 0,
        }
        self._member.beat(counters, gauges)
