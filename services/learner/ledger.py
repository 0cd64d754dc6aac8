"""What became of every rollout of every actor: the learner's memory, and the ledger that is counted from it.

    published = trained + refused(reason) + dropped + in flight + lost        (`Ledger.balance` is 0, always)

Two sides know parts of it. The learner knows the fate of what reached it. Of what did not, or reached only a
learner that has died since, the actor's report tells: given up (dropped), refused by a dead learner, accepted
by a dead learner (lost: no update of this one will use it). All of that is final, so a report may be late or
repeated. What then remains missing is in flight, or lost once the actor is dead.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from itertools import chain
from types import MappingProxyType
from typing import Any

from common.comms.messages import ActorReport, VerdictKind


class Fate(StrEnum):
    """What became of a rollout that was not refused."""

    QUEUED = "queued"  # accepted, and an update will use it
    TRAINED = "trained"
    LOST = "lost"  # accepted, and thrown away untrained
    DROPPED = "dropped"  # given up by its actor


FATES = frozenset(fate.value for fate in Fate)

Outcome = Fate | VerdictKind  # a kind of verdict stands for the refusal


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
        return Ledger(
            published=self.published + other.published,
            trained=self.trained + other.trained,
            refused=MappingProxyType(Counter(self.refused) + Counter(other.refused)),
            dropped=self.dropped + other.dropped,
            in_flight=self.in_flight + other.in_flight,
            lost=self.lost + other.lost,
        )


Span = tuple[int, int]  # half-open range of sequence numbers


@dataclass(frozen=True, slots=True)
class Remembered:
    """One incarnation as a checkpoint keeps it."""

    actor: str
    incarnation: int
    published: int
    outcomes: tuple[tuple[str, tuple[Span, ...]], ...]  # which sequence numbers ended how

    def to_json(self) -> dict[str, Any]:
        """Return plain values that `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Remembered":
        """Return what `to_json` gave, after a detour through JSON."""
        outcomes = tuple(
            (name, tuple((first, end) for first, end in ranges)) for name, ranges in values["outcomes"]
        )
        return cls(values["actor"], values["incarnation"], values["published"], outcomes)


RECENT = 1024
"""Rollouts behind the highest whose outcomes are kept one by one; older ones fold into spans: an actor that works for
days has millions."""


class Account:
    """What the learner knows about one incarnation of one actor."""

    def __init__(self, actor: str, incarnation: int) -> None:
        self.actor = actor
        self.incarnation = incarnation
        self.is_alive = True  # nothing that is missing will come from the dead
        self.last_heard = 0.0  # [s] on the caller's clock
        self.credit_limit = 0
        self._outcomes: dict[int, Outcome] = {}  # from ``_folded`` on
        self._spans: list[
            tuple[int, int, Outcome]
        ] = []  # half-open, of all numbers below ``_folded``, in order
        self._folded = 0
        self._counts: Counter[Outcome] = Counter()
        self._missing: set[int] = set()  # published, and no outcome known
        self._published = 0
        self._highest = -1

    @property
    def published(self) -> int:
        """How many sequence numbers are known to be used."""
        return self._published

    @property
    def missing(self) -> int:
        """How many of them we know nothing else about: under way to us, as long as the actor lives."""
        return len(self._missing)

    @property
    def gaps(self) -> int:
        """How many numbers are missing below the highest that came; with a window of 2, one may yet come."""
        return sum(sequence < self._highest for sequence in self._missing)

    def outcome(self, sequence: int) -> Outcome | None:
        """Return what became of a rollout, or None."""
        if sequence < self._folded:
            return self._spans[bisect_right(self._spans, sequence, key=lambda span: span[0]) - 1][2]
        return self._outcomes.get(sequence)

    def settle(self, sequence: int, outcome: Outcome) -> None:
        """Write down what became of a rollout; of one that is long final, no more."""
        if sequence < self._folded:
            return
        self._publish_up_to(sequence + 1)
        self._missing.discard(sequence)
        if (before := self._outcomes.get(sequence)) is not None:
            self._counts[before] -= 1
        self._outcomes[sequence] = outcome
        self._counts[outcome] += 1
        self._highest = max(self._highest, sequence)
        self._fold()

    def hear(self, report: ActorReport, generation: int) -> None:
        """Take over what the actor knows and the learner of ``generation`` may not."""
        self._publish_up_to(report.published)
        elsewhere: dict[int, Outcome] = {refusal.sequence: refusal.kind for refusal in report.refused}
        elsewhere.update(dict.fromkeys(report.dropped, Fate.DROPPED))
        if report.generation == generation:
            # what it doesn't list was accepted, and not by us; before it has heard us, it can't tell yet
            listed = elsewhere.keys() | set(report.in_flight)
            accepted = [s for s in self._missing if s < report.published and s not in listed]
            elsewhere.update(dict.fromkeys(accepted, Fate.LOST))
        for sequence in elsewhere.keys() & self._missing:
            self.settle(sequence, elsewhere[sequence])

    def ledger(self) -> Ledger:
        """Return the account."""
        missing = len(self._missing)
        refused = {kind: self._counts[kind] for kind in VerdictKind if self._counts[kind]}
        return Ledger(
            published=self._published,
            trained=self._counts[Fate.TRAINED],
            refused=MappingProxyType(refused),
            dropped=self._counts[Fate.DROPPED],
            in_flight=self._counts[Fate.QUEUED] + (missing if self.is_alive else 0),
            lost=self._counts[Fate.LOST] + (0 if self.is_alive else missing),
        )

    def remember(self) -> Remembered:
        """Return what a checkpoint keeps."""
        ranges: dict[str, list[Span]] = {}
        recent = ((sequence, sequence + 1, outcome) for sequence, outcome in sorted(self._outcomes.items()))
        for first, end, outcome in chain(self._spans, recent):
            of_one = ranges.setdefault(outcome.value, [])
            if of_one and of_one[-1][1] == first:
                of_one[-1] = (of_one[-1][0], end)
            else:
                of_one.append((first, end))
        outcomes = tuple((name, tuple(of_one)) for name, of_one in sorted(ranges.items()))
        return Remembered(self.actor, self.incarnation, self._published, outcomes)

    def _fold(self) -> None:
        """Fold what is final and long ago."""
        while self._folded < self._highest - RECENT:
            outcome = self._outcomes.get(self._folded)
            if outcome is None or outcome is Fate.QUEUED:
                return
            del self._outcomes[self._folded]
            if self._spans and self._spans[-1][2] == outcome:
                self._spans[-1] = (self._spans[-1][0], self._folded + 1, outcome)
            else:
                self._spans.append((self._folded, self._folded + 1, outcome))
            self._folded += 1

    def _publish_up_to(self, published: int) -> None:
        self._missing.update(range(self._published, published))
        self._published = max(self._published, published)


def restored(memory: Remembered) -> Account:
    """Return the account of a checkpoint; what was queued then died with that learner and is lost."""
    account = Account(memory.actor, memory.incarnation)
    account.is_alive = False  # until it is heard of
    in_order = sorted((first, end, name) for name, ranges in memory.outcomes for first, end in ranges)
    for first, end, name in in_order:
        outcome: Outcome = Fate(name) if name in FATES else VerdictKind(name)
        for sequence in range(first, end):
            account.settle(sequence, Fate.LOST if outcome is Fate.QUEUED else outcome)
    account._publish_up_to(memory.published)
    return account
