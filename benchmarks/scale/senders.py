"""Light senders: real sessions that send recorded rollouts by the actors' outbox, and play nothing.

Many of them live in one process, each with its own session, token, credits and numbers.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from threading import Event

from common.comms.codec import decode, encode
from common.comms.keys import Keys
from common.comms.messages import PolicySnapshot, Rollout, Verdict
from common.comms.transport import Flow, PendingReply, Reply, Transport
from common.comms.zenoh_config import ZenohConfig
from common.comms.zenoh_transport import open_zenoh
from services.actor import outbox as box
from services.actor.config import OutboxConfig
from services.actor.delivery import REPORT_INTERVAL_S

PAUSE_S = 0.002
REQUEST_S = 10.0
KEPT_TIMES = 20_000


@dataclass(frozen=True, slots=True)
class Part:
    """What one process of senders does."""

    endpoint: str
    run: str
    first: int  # number of its first sender
    count: int
    envs: int  # of the rollouts that they send
    takes_policies: bool  # whether they subscribe to policies, as actors do


@dataclass(frozen=True, slots=True)
class Sent:
    """What one process of senders has done so far."""

    ready: int  # senders that have an answer
    rollouts: int  # with a verdict
    refused: int
    reports: int
    policies: int
    verdict_s: tuple[float, ...]  # times from a request to its verdict, the newest


class Sender:
    """One light sender.

    Args:
        name: As an actor's id.
        transport: Its session.
        keys: The run's.
        rollout: What it sends, again and again.
        takes_policies: Whether it subscribes to policies.
    """

    def __init__(
        self, name: str, transport: Transport, keys: Keys, rollout: Rollout, takes_policies: bool
    ) -> None:
        self._name, self._transport, self._keys, self._rollout = name, transport, keys, rollout
        self._policies = transport.subscribe(keys.policy(), capacity=1) if takes_policies else None
        transport.declare_alive(keys.alive("actor", name, 1))
        self._outbox = box.Outbox(OutboxConfig())
        self._pending: dict[int, tuple[PendingReply, float]] = {}
        self._report: PendingReply | None = None
        self._next_report, self._report_after_s = 0.0, REPORT_INTERVAL_S
        self._known = (0, 0)  # generation and version of the learner
        self._stage_number = 0
        self.reports, self.policies = 0, 0
        self.verdict_s: list[float] = []

    @property
    def counts(self) -> box.Counts:
        """Its side of the ledger."""
        return self._outbox.counts

    @property
    def is_ready(self) -> bool:
        """Whether a learner has answered it."""
        return self._outbox.generation > 0

    def step(self, now: float) -> None:
        """Take what has come, and send what is due."""
        self._take_policy()
        for sequence, (pending, asked) in tuple(self._pending.items()):
            outcome = pending.poll()
            if outcome is None:
                continue
            del self._pending[sequence]
            if isinstance(outcome, Reply):
                verdict = decode(outcome.payload, Verdict)
                self._outbox = box.answered(self._outbox, sequence, verdict, now)
                self._learn(verdict)
                self.verdict_s.append(now - asked)
            else:
                self._outbox = box.unanswered(self._outbox, sequence, now)
        if self._report is not None and (outcome := self._report.poll()) is not None:
            self._report = None
            if isinstance(outcome, Reply):
                verdict = decode(outcome.payload, Verdict)
                self._outbox = box.credited(self._outbox, verdict)
                self._learn(verdict)
                self.reports += 1
                self._next_report = now + verdict.report_after_s
        generation, version = self._known
        if not box.idle_reason(self._outbox, generation, version):
            self._outbox = box.offer(self._outbox, self._payload(), now)
        elif not self._outbox.flights and self._report is None and now >= self._next_report:
            self._send_report(now)
        for flight in box.due(self._outbox, now):
            key = self._keys.rollout(self._name)
            pending = self._transport.request(key, flight.payload, REQUEST_S, Flow.ROLLOUT)
            self._pending[flight.sequence] = (pending, now)
            self._outbox = box.sent(self._outbox, flight.sequence)

    def _take_policy(self) -> None:
        for sample in self._policies.poll() if self._policies is not None else ():
            snapshot = decode(sample.payload, PolicySnapshot)
            self._known = max(self._known, (snapshot.generation, snapshot.version))
            self.policies += 1

    def _learn(self, verdict: Verdict) -> None:
        """Note the learner's version: rollouts say that it played them."""
        self._known = max(self._known, (verdict.generation, verdict.version))
        self._stage_number = verdict.stage_number

    def _payload(self) -> bytes:
        generation, version = self._known
        return encode(
            replace(
                self._rollout,
                run=self._keys.run,
                generation=generation,
                version=version,
                stage_number=self._stage_number,
                actor=self._name,
                incarnation=1,
                sequence=self._outbox.next_sequence,
            )
        )

    def _send_report(self, now: float) -> None:
        report = box.report(
            self._outbox,
            run=self._keys.run,
            actor=self._name,
            incarnation=1,
            version=self._known[1],
            training_hash=self._rollout.training_hash,
        )
        self._next_report = now + self._report_after_s
        self._report = self._transport.request(
            self._keys.report(self._name), encode(report), REQUEST_S, Flow.CONTROL
        )


def sent_by(senders: list[Sender]) -> Sent:
    """Return what these senders have done so far."""
    counts = [sender.counts for sender in senders]
    times = [seconds for sender in senders for seconds in sender.verdict_s]
    return Sent(
        ready=sum(sender.is_ready for sender in senders),
        rollouts=sum(count.accepted + sum(count.refused.values()) for count in counts),
        refused=sum(sum(count.refused.values()) for count in counts),
        reports=sum(sender.reports for sender in senders),
        policies=sum(sender.policies for sender in senders),
        verdict_s=tuple(times[-KEPT_TIMES:]),
    )


def work(part: Part, payload: bytes, commands: Connection) -> None:
    """Be a process of senders: answer ``None`` with what was done so far, and end at the end of the pipe."""
    keys, rollout = Keys(part.run), decode(payload, Rollout)
    with ExitStack() as stack:
        senders = list(_made(part, keys, rollout, stack))
        while True:
            now = time.monotonic()
            for sender in senders:
                sender.step(now)
            if commands.poll(PAUSE_S):
                try:
                    commands.recv()
                except (EOFError, OSError):
                    return
                commands.send(sent_by(senders))


def _made(part: Part, keys: Keys, rollout: Rollout, stack: ExitStack) -> Iterator[Sender]:
    for number in range(part.first, part.first + part.count):
        transport = stack.enter_context(closing(open_zenoh(ZenohConfig(endpoint=part.endpoint), Event())))
        yield Sender(f"s{number}", transport, keys, rollout, part.takes_policies)
