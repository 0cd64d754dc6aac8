"""The sending of rollouts as a value: numbered, retried under the same number, one final verdict each.

Pure functions: the clock is passed in. The actor's service sends the rollouts that `due` returns and reports each
result. A rollout is *published* when it gets its number. It stays *in flight* through any number of tries (a lost
answer, a server that is away or busy) until the learner's final verdict, or until it is too old and *dropped*:

    published = accepted + refused + dropped + in flight          (`Counts.balance` is 0, always)
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from common.comms.budgets import LISTED_REFUSALS
from common.comms.messages import FINAL_VERDICTS, ActorReport, Refusal, Verdict, VerdictKind
from services.actor.config import OutboxConfig


class OutboxFullError(RuntimeError):
    """A rollout was offered while the window is full."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One rollout in flight."""

    sequence: int
    payload: bytes
    born: float  # [s] on the caller's clock
    tries: int = 0
    next_try: float = 0.0  # [s]; not used while a request is pending
    under_way: bool = False


@dataclass(frozen=True, slots=True)
class Counts:
    """An actor's side of the ledger, cumulative over one incarnation."""

    published: int
    accepted: int
    refused: Mapping[VerdictKind, int]
    dropped: int
    in_flight: int

    @property
    def balance(self) -> int:
        """Rollouts that are unaccounted for: 0."""
        return self.published - self.accepted - sum(self.refused.values()) - self.dropped - self.in_flight


@dataclass(frozen=True, slots=True)
class Outbox:
    """All rollouts of one incarnation of an actor, and the learner's newest credits; its size is bounded."""

    config: OutboxConfig
    next_sequence: int = 0
    flights: tuple[Flight, ...] = ()
    accepted: int = 0
    refused_by_kind: tuple[tuple[VerdictKind, int], ...] = ()
    dropped_count: int = 0
    refused: tuple[Refusal, ...] = ()  # the newest, as many as a report lists
    dropped: tuple[int, ...] = ()  # the same
    generation: int = 0  # of the learner that answered last; 0: none yet
    credit_limit: int = 0
    credit_version: int = 0

    @property
    def counts(self) -> Counts:
        """The counts of the ledger."""
        return Counts(
            published=self.next_sequence,
            accepted=self.accepted,
            refused=dict(self.refused_by_kind),
            dropped=self.dropped_count,
            in_flight=len(self.flights),
        )


def idle_reason(outbox: Outbox, generation: int, version: int) -> str:
    """Return what the actor must wait for before it plays a rollout with this policy, or ""."""
    if len(outbox.flights) >= outbox.config.window:
        return f"the learner's verdict on rollout {outbox.flights[0].sequence}"
    if outbox.generation != generation:
        return "the learner's first answer" if outbox.generation == 0 else "policy and credits of one learner"
    if version < outbox.credit_version:
        return f"policy version {outbox.credit_version}"
    if outbox.next_sequence >= outbox.credit_limit:
        return "the learner's credits"
    return ""


def offer(outbox: Outbox, payload: bytes, now: float) -> Outbox:
    """Return the outbox with one more rollout, numbered ``outbox.next_sequence``, due at once."""
    if len(outbox.flights) >= outbox.config.window:
        raise OutboxFullError(f"{len(outbox.flights)} rollouts in flight; allowed: {outbox.config.window}")
    flight = Flight(sequence=outbox.next_sequence, payload=payload, born=now, next_try=now)
    return replace(outbox, next_sequence=outbox.next_sequence + 1, flights=(*outbox.flights, flight))


def due(outbox: Outbox, now: float) -> tuple[Flight, ...]:
    """Return the rollouts to send now, oldest first."""
    return tuple(flight for flight in outbox.flights if not flight.under_way and now >= flight.next_try)


def sent(outbox: Outbox, sequence: int) -> Outbox:
    """Return the outbox after a request for ``sequence`` went out."""
    return _changed(outbox, sequence, lambda flight: replace(flight, under_way=True, tries=flight.tries + 1))


def at_once(outbox: Outbox, now: float) -> Outbox:
    """Return the outbox with all waiting retries due now."""
    return replace(outbox, flights=tuple(replace(flight, next_try=now) for flight in outbox.flights))


def unanswered(outbox: Outbox, sequence: int, now: float) -> Outbox:
    """Return the outbox after a request ended without an answer: the same number is sent again later."""
    return _changed(outbox, sequence, lambda flight: _backed_off(flight, outbox.config, now))


def answered(outbox: Outbox, sequence: int, verdict: Verdict, now: float) -> Outbox:
    """Return the outbox after a verdict; if its rollout is no longer in flight, only the credits change."""
    outbox = credited(outbox, verdict, (sequence + 1, 0))  # it was played with a credit for this number
    if sequence not in (flight.sequence for flight in outbox.flights):
        return outbox
    # a duplicate's recorded verdict is in ``first``: the answer to an earlier try was lost
    if verdict.first not in FINAL_VERDICTS:
        return unanswered(outbox, sequence, now)
    rest = tuple(flight for flight in outbox.flights if flight.sequence != sequence)
    if verdict.first is VerdictKind.ACCEPTED:
        return replace(outbox, flights=rest, accepted=outbox.accepted + 1)
    refusal = Refusal(sequence=sequence, kind=verdict.first, generation=verdict.generation)
    counts = dict(outbox.refused_by_kind)
    counts[refusal.kind] = counts.get(refusal.kind, 0) + 1
    # Apart, since a report lists those of earlier learners alone
    own = [*(r for r in outbox.refused if r.generation == refusal.generation), refusal]
    others = [r for r in outbox.refused if r.generation != refusal.generation]
    newest = (*others[-LISTED_REFUSALS:], *own[-LISTED_REFUSALS:])
    return replace(outbox, flights=rest, refused_by_kind=tuple(sorted(counts.items())), refused=newest)


def credited(outbox: Outbox, verdict: Verdict, known: tuple[int, int] = (0, 0)) -> Outbox:
    """Return the outbox with the credits that came with a verdict of the followed learner.

    Args:
        outbox: The outbox.
        verdict: The learner's answer.
        known: Limit and version of the credits when the request was sent. A learner takes none back, so an answer with
            less shows that they were forged, and counts as it is.
    """
    limit, version = verdict.credit_limit, verdict.credit_version
    is_as_known = limit >= known[0] and version >= known[1]
    if verdict.generation == outbox.generation and is_as_known:
        limit = max(outbox.credit_limit, limit)
        version = max(outbox.credit_version, version)
    return replace(outbox, generation=verdict.generation, credit_limit=limit, credit_version=version)


def expired(outbox: Outbox, now: float) -> Outbox:
    """Return the outbox without rollouts that are too old; one with a pending request stays."""
    too_old = [
        flight.sequence
        for flight in outbox.flights
        if not flight.under_way and flight.tries > 0 and now - flight.born >= outbox.config.give_up_s
    ]
    rest = tuple(flight for flight in outbox.flights if flight.sequence not in too_old)
    newest = (*outbox.dropped, *too_old)[-LISTED_REFUSALS:]
    return replace(outbox, flights=rest, dropped_count=outbox.dropped_count + len(too_old), dropped=newest)


def report(
    outbox: Outbox,
    *,
    run: str,
    actor: str,
    incarnation: int,
    version: int,
    training_hash: str,
    leaving: bool = False,
) -> ActorReport:
    """Return what the learner needs to balance its ledger."""
    return ActorReport(
        run=run,
        actor=actor,
        incarnation=incarnation,
        version=version,
        published=outbox.next_sequence,
        in_flight=tuple(flight.sequence for flight in outbox.flights),
        dropped=outbox.dropped,
        generation=outbox.generation,
        refused=tuple(r for r in outbox.refused if r.generation != outbox.generation)[-LISTED_REFUSALS:],
        leaving=leaving,
        training_hash=training_hash,
    )


def _changed(outbox: Outbox, sequence: int, change: Callable[[Flight], Flight]) -> Outbox:
    flights = tuple(change(flight) if flight.sequence == sequence else flight for flight in outbox.flights)
    return replace(outbox, flights=flights)


def _backed_off(flight: Flight, config: OutboxConfig, now: float) -> Flight:
    doublings = min(flight.tries - 1, 32)  # far beyond any retry_max_s, without overflow
    pause_s = min(config.retry_first_s * 2.0**doublings, config.retry_max_s)
    return replace(flight, under_way=False, next_try=now + pause_s)
