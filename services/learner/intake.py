"""Which rollouts wait for an update, what the learner says to each, and how many more it wants.

Pure: no network, no clock of its own, no arrays touched.

Lag is counted to where a rollout will be used: everything queued before it, and an update that is running,
raise the version that it will meet. So what is accepted never turns too old while it waits.

Pacing: every verdict carries the number below which its actor may publish. The limits add up to what today's
version is still wanted for, so that actors pause rather than play what would be refused, which would favour
short episodes. An actor without credits reports until it gets some: no grant can be lost for good.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.comms.messages import ActorReport, Rollout, Verdict, VerdictKind
from services.learner.ledger import Account, Fate, Ledger, Outcome, Remembered, restored
from services.learner.verdicts import Case, Header, Standing, judge

# Of these nothing is written down: the rollout has been judged, or is to come again.
_UNRECORDED: Final = frozenset({VerdictKind.DUPLICATE, VerdictKind.BUSY})


class IntakeConfig(BaseModel):
    """How much data an update takes, and how old it may be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset_rollouts: int = Field(
        1, ge=1, description="rollouts of one dataset; deploy.local: one of each actor, unless it is given"
    )
    max_lag: int = Field(
        2, ge=0, le=64, description="versions that a rollout may be behind; 0 is strictly synchronous"
    )
    target_lag: int = Field(1, ge=0, le=64, description="lag that the pacing aims at, where max_lag allows")
    queue_rollouts: int = Field(
        256, ge=1, description="rollouts that may wait, a dataset at least; bounds the memory"
    )
    window: int = Field(2, ge=1, le=16, description="credits that one actor may hold")
    credit_patience_s: float = Field(
        30.0,
        gt=0,
        description="silence after which an actor's unused credits go to others",
        json_schema_extra={"unit": "s"},
    )

    @model_validator(mode="after")
    def _a_dataset_fits_into_the_queue(self) -> Self:
        if self.dataset_rollouts > self.queue_rollouts:
            raise ValueError(
                f"dataset_rollouts {self.dataset_rollouts}; allowed: up to queue_rollouts, {self.queue_rollouts}"
            )
        return self

    @property
    def lag_aimed_at(self) -> int:
        """Return how many datasets beyond the present one are collected ahead."""
        return min(self.target_lag, self.max_lag)


@dataclass(frozen=True, slots=True)
class Queued:
    """An accepted rollout that waits for its update, or is in it."""

    header: Header
    rollout: Rollout


class Intake:
    """The learner's side of every rollout's way from its arrival to its update."""

    def __init__(self, config: IntakeConfig, standing: Standing, memory: Iterable[Remembered] = ()) -> None:
        self._config = config
        self._standing = standing
        self._accounts = {(entry.actor, entry.incarnation): restored(entry) for entry in memory}
        self._queue: deque[Queued] = deque()
        self._in_update: tuple[Queued, ...] = ()

    @property
    def standing(self) -> Standing:
        """Where the learner is."""
        return self._standing

    @property
    def queued(self) -> int:
        """How many rollouts wait for an update."""
        return len(self._queue)

    def arrive(self, header: Header, rollout: Rollout | None, now: float) -> Verdict:
        """Return the verdict on a rollout, which is queued if it is accepted.

        Args:
            header: What the message says about itself.
            rollout: Its content; None only if ``header.fault`` says why.
            now: The caller's clock [s].
        """
        known = self._known(header)
        case = Case(
            header=header,
            standing=self._standing,
            is_known=known is not None,
            queued=len(self._queue),
            queue_limit=self._queue_limit(),
            version_at_use=self._version_at_use(),
            max_lag=self._config.max_lag,
        )
        kind, reason = judge(case)
        if kind is VerdictKind.WRONG_RUN:  # the namesake of an actor of ours: no account of it here
            return self._verdict(kind, kind, reason)
        account = self._heard(header.actor, header.incarnation, now)
        if kind is VerdictKind.ACCEPTED:
            if rollout is None:
                raise ValueError("a rollout without content needs a fault in its header")
            account.settle(header.sequence, Fate.QUEUED)
            self._queue.append(Queued(header, rollout))
        elif kind not in _UNRECORDED:
            account.settle(header.sequence, kind)
        first: VerdictKind = kind
        if kind is VerdictKind.DUPLICATE:
            first = known if isinstance(known, VerdictKind) else VerdictKind.ACCEPTED
        self._grant(account, now)
        return self._verdict(kind, first, reason, account.credit_limit)

    def unreadable(self, reason: str) -> Verdict:
        """Return the answer to a payload of which nobody can say whose it is: its sender tries again."""
        return self._verdict(VerdictKind.UNREADABLE, VerdictKind.UNREADABLE, reason)

    def report(self, report: ActorReport, now: float) -> Verdict:
        """Return fresh credits for an actor, which is alive if it says so, unless its token has gone since.

        News of a death overtakes what the dead said last. Whoever was only cut off is seen again, and then heard.
        """
        account = self._heard(report.actor, report.incarnation, now)
        account.hear(report, self._standing.generation)
        account.is_alive = not (report.leaving or account.is_out_of_sight)
        self._grant(account, now)
        return self._verdict(VerdictKind.CREDITS, VerdictKind.CREDITS, "", account.credit_limit)

    def gone(self, actor: str, incarnation: int) -> None:
        """Note that an actor died or left: what it had under way is lost, its credits are free."""
        account = self._accounts.setdefault((actor, incarnation), Account(actor, incarnation))
        account.is_alive, account.is_out_of_sight = False, True

    def seen(self, actor: str, incarnation: int) -> None:
        """Note that an actor's token is in sight: one that had gone is back, and what it has under way may come."""
        account = self._accounts.get((actor, incarnation))
        if account is not None and account.is_out_of_sight:
            account.is_alive, account.is_out_of_sight = True, False

    def take_dataset(self) -> tuple[Queued, ...]:
        """Return the rollouts of the next dataset, oldest first, and start its update; () while too few wait.

        Raises:
            RuntimeError: An update is running: `finish_update` must come first.
        """
        if self._in_update:
            raise RuntimeError(f"an update of {len(self._in_update)} rollouts is running")
        if len(self._queue) < self._config.dataset_rollouts:
            return ()
        self._in_update = tuple(self._queue.popleft() for _ in range(self._config.dataset_rollouts))
        return self._in_update

    def finish_update(self, standing: Standing) -> None:
        """Write the dataset down as trained; what waits and can't be used at the new standing is lost."""
        for entry in self._in_update:
            self._settle(entry, Fate.TRAINED)
        self._in_update = ()
        self._standing = standing
        waiting, self._queue = self._queue, deque()
        for entry in waiting:
            stays = entry.header.stage_number == standing.stage_number and (
                self._version_at_use() - entry.header.version <= self._config.max_lag
            )
            if stays:
                self._queue.append(entry)
            else:
                self._settle(entry, Fate.LOST)

    def ledgers(self) -> dict[tuple[str, int], Ledger]:
        """Return the account of every (actor, incarnation)."""
        return {key: account.ledger() for key, account in self._accounts.items()}

    def gaps(self) -> int:
        """Return how many sequence numbers are missing below the highest that came, over all actors."""
        return sum(account.gaps for account in self._accounts.values())

    def memory(self) -> tuple[Remembered, ...]:
        """Return what a checkpoint keeps, so that the next learner tells a retry from news."""
        return tuple(account.remember() for account in self._accounts.values())

    def _settle(self, entry: Queued, fate: Fate) -> None:
        header = entry.header
        self._accounts[header.actor, header.incarnation].settle(header.sequence, fate)

    def _heard(self, actor: str, incarnation: int, now: float) -> Account:
        account = self._accounts.setdefault((actor, incarnation), Account(actor, incarnation))
        account.last_heard = now
        return account

    def _queue_limit(self) -> int:
        """Return how many rollouts may wait: no more than this stage will train on.

        One that came after the last dataset of a stage would be accepted only to be lost at the change.
        """
        datasets = self._standing.datasets_left - bool(self._in_update)
        return max(0, min(self._config.queue_rollouts, datasets * self._config.dataset_rollouts))

    def _version_at_use(self) -> int:
        datasets_before = len(self._queue) // self._config.dataset_rollouts + bool(self._in_update)
        return self._standing.version + datasets_before

    def _known(self, header: Header) -> Outcome | None:
        account = self._accounts.get((header.actor, header.incarnation))
        return None if account is None else account.outcome(header.sequence)

    def _verdict(self, kind: VerdictKind, first: VerdictKind, reason: str, credit_limit: int = 0) -> Verdict:
        standing = self._standing
        return Verdict(
            kind=kind,
            first=first,
            reason=reason,
            generation=standing.generation,
            version=standing.version,
            stage_number=standing.stage_number,
            stage=standing.stage,
            credit_limit=credit_limit,
            credit_version=standing.version,
        )

    def _grant(self, account: Account, now: float) -> None:
        """Raise the actor's limit as far as the data is wanted and its window allows."""
        wanted = self._wanted(now)
        room = self._config.window - self._outstanding(account)
        if account.is_alive and min(wanted, room) > 0:
            account.credit_limit = max(account.credit_limit, account.published) + min(wanted, room)

    def _wanted(self, now: float) -> int:
        """Return how many more rollouts of today's version would be used within the lag that is aimed at."""
        # nothing is collected for after a stage change: it would be lost
        ahead = min(self._config.lag_aimed_at + 1, self._standing.datasets_left)
        datasets = ahead - bool(self._in_update)
        promised = sum(
            self._outstanding(account)
            for account in self._accounts.values()
            if account.is_alive and now - account.last_heard < self._config.credit_patience_s
        )
        return datasets * self._config.dataset_rollouts - len(self._queue) - promised

    def _outstanding(self, account: Account) -> int:
        """Return how many rollouts an actor may still send or has under way."""
        return max(0, account.credit_limit - account.published) + account.missing
