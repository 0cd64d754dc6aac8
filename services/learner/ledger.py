"""The fate of every rollout of every actor, and the ledger that is counted from it.

    published = trained + refused(reason) + dropped + in flight + lost        (`Ledger.balance` is 0, always)

Learner and actor each know a part. The learner knows the fate of the rollouts that it received. The actor's report
has the others: dropped by the actor, refused by an earlier learner, accepted by an earlier learner (lost: no update of
this one will use it). These fates are final, so a report may be late or repeated. A rollout that is then still missing
is in flight, or lost once the actor is dead.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from common.comms.messages import ActorReport, VerdictKind


class Fate(StrEnum):
    """The fate of a rollout that was not refused."""

    QUEUED = "queued"  # accepted, and an update will use it
    TRAINED = "trained"
    LOST = "lost"  # accepted, and discarded untrained
    DROPPED = "dropped"  # its actor stopped trying


FATES = frozenset(fate.value for fate in Fate)

Outcome = Fate | VerdictKind  # a kind of verdict means a refusal of that kind


@dataclass(frozen=True, slots=True)
class Ledger:
    """The account of one incarnation of an actor, or the sum of several."""

    published: int = 0
    trained: int = 0
    refused: Mapping[VerdictKind, int] = field(default_factory=lambda: MappingProxyType({}))
    dropped: int = 0
    in_flight: int = 0
    lost: int = 0

    @property
    def balance(self) -> int:
        """Rollouts that are unaccounted for: 0."""
        accounted = self.trained + sum(self.refused.values()) + self.dropped + self.in_flight + self.lost
        return self.published - accounted

    def __add__(self, other: "Ledger") -> "Ledger":
        """Return the account of both together."""
        return self._joined(other, 1)

    def __sub__(self, other: "Ledger") -> "Ledger":
        """Return the account without ``other``, which is a part of it."""
        return self._joined(other, -1)

    def _joined(self, other: "Ledger", sign: int) -> "Ledger":
        refused = Counter(self.refused)
        for kind, count in other.refused.items():
            refused[kind] += sign * count
        return Ledger(
            published=self.published + sign * other.published,
            trained=self.trained + sign * other.trained,
            refused=MappingProxyType({kind: count for kind, count in refused.items() if count}),
            dropped=self.dropped + sign * other.dropped,
            in_flight=self.in_flight + sign * other.in_flight,
            lost=self.lost + sign * other.lost,
        )


Span = tuple[int, int]  # half-open range of sequence numbers


@dataclass(frozen=True, slots=True)
class AccountSnapshot:
    """One incarnation as a checkpoint keeps it."""

    actor: str
    incarnation: int
    published: int
    outcomes: tuple[tuple[str, tuple[Span, ...]], ...]  # fates, and the sequence numbers of each

    def to_json(self) -> dict[str, Any]:
        """Return plain values that `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "AccountSnapshot":
        """Return what `to_json` gave, after a round trip through JSON."""
        outcomes = tuple(
            (name, tuple((first, end) for first, end in ranges)) for name, ranges in values["outcomes"]
        )
        return cls(values["actor"], values["incarnation"], values["published"], outcomes)


class Account:
    """What the learner knows about one incarnation of one actor.

    An actor that runs for months numbers hundreds of millions of rollouts, and nearly all have the same outcome. So
    outcomes are kept as ranges: memory depends on how often the outcome changes, not on the number of rollouts or on
    the highest number that a message claims.
    """

    def __init__(self, actor: str, incarnation: int) -> None:
        self.actor = actor
        self.incarnation = incarnation
        self.is_out_of_sight = False  # its liveliness token is gone: its reports are older than that
        self.fits = False  # its last message had the learner's task, network and experience
        self.last_progress = 0.0  # [s] time of its last grant or new rollout, on the caller's clock
        self.refused_in_a_row = 0
        self.no_credits_before = 0.0  # [s] end of its pause after refusals
        self.credit_limit = 0
        self.changes = 0  # of what its ledger counts
        self._is_alive = True
        self._known: list[tuple[int, int, Outcome]] = []  # half-open ranges in order, merged where they meet
        self._counts: Counter[Outcome] = Counter()
        self._published = 0

    @property
    def is_alive(self) -> bool:
        """Whether missing rollouts may arrive. Those of a dead actor will not."""
        return self._is_alive

    @is_alive.setter
    def is_alive(self, value: bool) -> None:
        self.changes += value != self._is_alive
        self._is_alive = value

    @property
    def queued(self) -> int:
        """How many rollouts wait for an update, or are in it."""
        return self._counts[Fate.QUEUED]

    @property
    def published(self) -> int:
        """How many sequence numbers are known to be used."""
        return self._published

    @property
    def missing(self) -> int:
        """How many of them have no known outcome: in flight as long as the actor lives."""
        return self._published - self._counts.total()

    @property
    def gaps(self) -> int:
        """How many numbers are missing below the highest that arrived; with a window of 2, one may still arrive."""
        return (self._known[-1][1] if self._known else 0) - self._counts.total()

    @property
    def ranges(self) -> int:
        """Number of ranges of equal outcomes: the account's memory."""
        return len(self._known)

    def outcome(self, sequence: int) -> Outcome | None:
        """Return the outcome of a rollout, or None."""
        at = self._at(sequence) - 1
        return self._known[at][2] if at >= 0 and sequence < self._known[at][1] else None

    def settle(self, sequence: int, outcome: Outcome) -> None:
        """Record the outcome of a rollout; a final outcome does not change."""
        if self.outcome(sequence) in (None, Fate.QUEUED):
            self._write(sequence, sequence + 1, outcome)

    def hear(self, report: ActorReport, generation: int) -> None:
        """Record the outcomes that the actor knows and the learner of ``generation`` may not."""
        if report.published > self._published:
            self.changes += 1
            self._published = report.published
        elsewhere: dict[int, Outcome] = {refusal.sequence: refusal.kind for refusal in report.refused}
        elsewhere.update(dict.fromkeys(report.dropped, Fate.DROPPED))
        for sequence, outcome in elsewhere.items():
            if sequence < self._published and self.outcome(sequence) is None:
                self._write(sequence, sequence + 1, outcome)
        if report.generation == generation:
            # Unlisted numbers were accepted by an earlier learner. Before this one answers, the actor can't know that.
            for first, end in self._missing_below(report.published, set(report.in_flight)):
                self._write(first, end, Fate.LOST)

    def ledger(self) -> Ledger:
        """Return the account."""
        refused = {kind: self._counts[kind] for kind in VerdictKind if self._counts[kind]}
        return Ledger(
            published=self._published,
            trained=self._counts[Fate.TRAINED],
            refused=MappingProxyType(refused),
            dropped=self._counts[Fate.DROPPED],
            in_flight=self._counts[Fate.QUEUED] + (self.missing if self.is_alive else 0),
            lost=self._counts[Fate.LOST] + (0 if self.is_alive else self.missing),
        )

    def snapshot(self) -> AccountSnapshot:
        """Return what a checkpoint keeps."""
        ranges: dict[str, list[Span]] = {}
        for first, end, outcome in self._known:
            ranges.setdefault(outcome.value, []).append((first, end))
        outcomes = tuple((name, tuple(of_one)) for name, of_one in sorted(ranges.items()))
        return AccountSnapshot(self.actor, self.incarnation, self._published, outcomes)

    def _at(self, sequence: int) -> int:
        """Return how many ranges begin at ``sequence`` or before."""
        return bisect_right(self._known, sequence, key=lambda known: known[0])

    def _write(self, first: int, end: int, outcome: Outcome) -> None:
        """Record the outcome of a range whose numbers have no outcome yet, or all the same one."""
        self.changes += 1
        if (before := self.outcome(first)) is not None:
            self._counts[before] -= end - first
        self._counts[outcome] += end - first
        self._published = max(self._published, end)
        at = self._at(first)
        near = slice(max(at - 2, 0), at + 1)  # ranges that the new one may cut or join
        pieces = [(first, end, outcome)]
        for start, stop, known in self._known[near]:
            pieces += [(start, min(stop, first), known), (max(start, end), stop, known)]
        joined: list[tuple[int, int, Outcome]] = []
        for piece in sorted(piece for piece in pieces if piece[0] < piece[1]):
            if joined and joined[-1][1:] == (piece[0], piece[2]):
                joined[-1] = (joined[-1][0], *piece[1:])
            else:
                joined.append(piece)
        self._known[near] = joined

    def _missing_below(self, end: int, listed: Set[int]) -> list[Span]:
        """Return the ranges below ``end`` without a known outcome, except the numbers that are ``listed``."""
        if not self.missing:
            return []
        taken = sorted([(first, stop) for first, stop, _ in self._known] + [(n, n + 1) for n in listed])
        found, start = [], 0
        for first, stop in [*taken, (end, end)]:
            if start < min(first, end):
                found.append((start, min(first, end)))
            start = max(start, stop)
        return found


def restored(memory: AccountSnapshot, kept: Set[int] = frozenset()) -> Account:
    """Return the account of a checkpoint. Its missing rollouts are in flight until its owner is known to be gone.

    Args:
        memory: The account as it was.
        kept: Rollouts that the checkpoint holds; they are still queued. The others that were queued then are lost.
    """
    account = Account(memory.actor, memory.incarnation)
    in_order = sorted((first, end, name) for name, ranges in memory.outcomes for first, end in ranges)
    for first, end, name in in_order:
        outcome: Outcome = Fate(name) if name in FATES else VerdictKind(name)
        account._write(first, end, Fate.LOST if outcome is Fate.QUEUED else outcome)
        if outcome is Fate.QUEUED:
            for sequence in kept:
                if first <= sequence < end:
                    account._write(sequence, sequence + 1, Fate.QUEUED)
    account._published = max(account._published, memory.published)
    return account


def folded(earlier: Account, account: Account) -> Account:
    """Return ``earlier`` with the counts of one more account whose owner is gone; its missing rollouts are lost.

    The result is as large as one account, whatever the number of lives in it. Its numbers name no rollouts.
    """
    counts = earlier._counts + account._counts
    counts[Fate.LOST] += earlier.missing + account.missing
    result = Account(earlier.actor, earlier.incarnation)
    for outcome in sorted(counts, key=lambda outcome: outcome.value):
        if counts[outcome]:
            result._write(result.published, result.published + counts[outcome], outcome)
    result.is_alive = False
    return result
