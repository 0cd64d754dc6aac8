"""The delivery of an actor's rollouts: each is sent until it has its verdict; reports keep the credits up to date."""

import logging
import time
from typing import Final

from common.comms.codec import DecodeError, decode, encode
from common.comms.messages import FINAL_VERDICTS, ActorReport, Rollout, Verdict, VerdictKind
from common.comms.transport import Flow, NoReply, PendingReply, Reply, Transport
from common.service.history import History
from common.service.member import Member
from common.service.metrics import Metrics
from services.actor import outbox as box
from services.actor.config import IDLE_WAIT_S, ActorConfig
from services.actor.player import Player
from services.actor.policy_feed import PolicyFeed

log = logging.getLogger(__name__)

REPORT_INTERVAL_S: Final = (
    0.25  # while without credits, until the learner sets another: a lost grant is repeated
)
REPORT_TIMEOUT_S: Final = 5.0
LAST_VERDICTS_S: Final = 2.0  # wait at the end for rollouts in flight
LAST_REPORT_S: Final = 2.0
REFUSALS: Final = FINAL_VERDICTS - {VerdictKind.ACCEPTED}


class Delivery:
    """Sends an actor's rollouts to the learner, and keeps the actor's side of the ledger.

    Args:
        config: Settings of the actor.
        transport: Connection to the hub.
        member: The actor's membership; counts refused messages.
        player: Its policy and contract are reported.
        policies: Says which learner is followed.
        history: Records what happens to each rollout.
        metrics: Receives the numbers of rollouts.
    """

    def __init__(
        self,
        config: ActorConfig,
        transport: Transport,
        member: Member,
        player: Player,
        policies: PolicyFeed,
        history: History,
        metrics: Metrics,
    ) -> None:
        self._config, self._transport, self._member = config, transport, member
        self._player, self._policies = player, policies
        self._history, self._metrics = history, metrics
        self.outbox = box.Outbox(config.outbox)
        self.life_ended = ""  # why the learner hears this life of the actor no more
        self._pending: dict[int, PendingReply] = {}
        self._report: PendingReply | None = None
        self._next_report, self._report_after_s = 0.0, REPORT_INTERVAL_S
        self._known_credits = (0, 0, 0)  # generation, limit and version of the credits at the last report
        self._reported = (0, 0)  # generation and version of the policy in the last report
        for kind in REFUSALS:  # from nothing to 1 would be no rise for Prometheus
            metrics.inc("topspin_rollouts_refused_total", 0.0, reason=kind.value)

    def offer(self, rollout: Rollout, now: float) -> None:
        """Take a rollout, numbered ``outbox.next_sequence``, to be sent from ``now`` [s] on."""
        self.outbox = box.offer(self.outbox, encode(rollout), now)
        self._metrics.inc("topspin_rollouts_published_total", 1.0)

    def send(self, now: float) -> None:
        """Send the rollouts that are due."""
        for flight in box.due(self.outbox, now):
            if flight.tries:
                self._metrics.inc("topspin_rollouts_retried_total", 1.0)
            self._history.note("sent", number=flight.sequence, tries=flight.tries + 1)
            self._pending[flight.sequence] = self._transport.request(
                self._member.keys.rollout(self._config.id, self._policies.rank or 0),
                flight.payload,
                self._config.outbox.request_timeout_s,
                Flow.ROLLOUT,
            )
            self._metrics.inc("topspin_bytes_sent_total", len(flight.payload))
            self.outbox = box.sent(self.outbox, flight.sequence)

    def take_verdicts(self, now: float) -> None:
        """Take the learner's answers to rollouts and reports."""
        for sequence, pending in list(self._pending.items()):
            outcome = pending.poll()
            if outcome is None:
                continue
            del self._pending[sequence]
            verdict = self._verdict(outcome)
            if verdict is None:
                self.outbox = box.unanswered(self.outbox, sequence, now)
                continue
            before = self.outbox.counts
            self.outbox = box.answered(self.outbox, sequence, verdict, now)
            self._count(sequence, before, verdict)
        if self._report is not None and (outcome := self._report.poll()) is not None:
            self._report = None
            verdict = self._verdict(outcome)
            if verdict is not None and verdict.kind is VerdictKind.LIFE_ENDED:
                self.life_ended = verdict.reason
            elif verdict is not None:
                generation, limit, version = self._known_credits
                known = (limit, version) if generation == verdict.generation else (0, 0)
                self.outbox = box.credited(self.outbox, verdict, known)
                self._report_after_s = verdict.report_after_s
                self._policies.heed(verdict, self._reported)

    def drop_old(self, now: float) -> None:
        """Give up the rollouts that are too old."""
        before = self.outbox.flights
        self.outbox = box.expired(self.outbox, now)
        for flight in before:
            if flight not in self.outbox.flights:
                self._history.note("dropped", number=flight.sequence)

    def report_at_once(self) -> None:
        """Make a report due: its answer brings credits."""
        self._next_report = 0.0

    def report_if_due(self, now: float) -> None:
        """Report to the learner, if the last report has ended and another is due."""
        is_free = self._report is None or self._report.poll() is not None
        if is_free and now >= self._next_report and self._policies.rank is not None:
            self._next_report = now + self._report_after_s
            self._report = self._send_report(leaving=False, timeout_s=REPORT_TIMEOUT_S)

    def end(self) -> None:
        """Wait up to 2 s for a verdict on every rollout, and report to the learner that no more rollouts follow."""
        now = time.monotonic()
        deadline = now + LAST_VERDICTS_S
        self.outbox = box.at_once(self.outbox, now)  # a rollout that waits for its next try is sent now
        while self.outbox.flights and now < deadline:
            self.send(now)
            self._transport.wait(IDLE_WAIT_S)
            now = time.monotonic()
            self._policies.note_learners()
            self.take_verdicts(now)
        if self._policies.rank is not None:
            pending = self._send_report(leaving=True, timeout_s=LAST_REPORT_S)
            if pending.wait() is NoReply.TIMEOUT:
                log.warning("the learner did not answer the last report")

    def _send_report(self, leaving: bool, timeout_s: float) -> PendingReply:
        snapshot, outbox = self._player.snapshot, self.outbox
        report: ActorReport = box.report(
            outbox,
            run=self._config.run,
            actor=self._config.id,
            incarnation=self._member.incarnation,
            version=snapshot.version if snapshot else 0,
            training_hash=self._player.training_hash,
            leaving=leaving,
        )
        self._reported = (snapshot.generation, snapshot.version) if snapshot else (0, 0)
        self._known_credits = (outbox.generation, outbox.credit_limit, outbox.credit_version)
        key = self._member.keys.report(self._config.id, self._policies.rank or 0)
        return self._transport.request(key, encode(report), timeout_s, Flow.CONTROL)

    def _verdict(self, outcome: Reply | NoReply) -> Verdict | None:
        """Return the verdict in an answer; None if there is none of the followed learner."""
        if isinstance(outcome, NoReply):
            return None
        try:
            verdict = decode(outcome.payload, Verdict)
        except DecodeError as error:
            self._member.refuse("verdict", error)
            return None
        if fault := self._policies.objection(verdict.generation):
            self._member.refuse("verdict", fault)
            return None
        return verdict

    def _count(self, sequence: int, before: box.Counts, verdict: Verdict) -> None:
        """Record a rollout's final verdict."""
        after = self.outbox.counts
        is_accepted = after.accepted > before.accepted
        is_refused = sum(after.refused.values()) > sum(before.refused.values())
        if not is_accepted and not is_refused:
            return
        kind = verdict.first.value
        self._history.note("verdict", number=sequence, kind=kind, generation=verdict.generation)
        if is_accepted:
            self._metrics.inc("topspin_rollouts_accepted_total", 1.0)
        else:
            self._metrics.inc("topspin_rollouts_refused_total", 1.0, reason=kind)
            log.warning("rollout refused kind=%s reason=%r", kind, verdict.reason)
