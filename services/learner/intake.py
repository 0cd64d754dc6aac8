"""Which rollouts wait for an update, the verdict on each, and how many more the learner needs.

It has state, but no network and no clock of its own, and it reads no array of a rollout.

Lag is counted to the version at use: each dataset queued before a rollout, and a running update, raise it by one. So an
accepted rollout never becomes too old while it waits.

Pacing: every verdict carries the number below which its actor may publish. The limits add up to the rollouts that are
still needed of the present version. So actors pause instead of playing rollouts that would be refused, which would
favour short episodes. An actor without credits reports until it gets some, so that no grant is lost for good.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from common.comms.messages import ActorReport, Rollout, Verdict, VerdictKind
from services.learner.admission import Case, Header, LearnerState, judge
from services.learner.ledger import Account, AccountSnapshot, Fate, Ledger, Outcome, restored

# These are not recorded: the rollout has a verdict, or its actor sends it again.
_UNRECORDED: Final = frozenset({VerdictKind.DUPLICATE, VerdictKind.BUSY})


class IntakeConfig(BaseModel):
    """How much data an update takes, and how old it may be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset_rollouts: int = Field(0, ge=0, description="rollouts of one dataset; 0: one of each actor")
    max_lag: int = Field(
        2,
        ge=0,
        le=64,
        description="versions that a rollout may be older than the learner's; 0 is strictly synchronous",
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

    def for_actors(self, actors: int) -> Self:
        """Return the settings with the size of a dataset for so many actors, and a queue of at least two datasets."""
        rollouts = self.dataset_rollouts or actors
        queue = self.queue_rollouts if self.dataset_rollouts else max(self.queue_rollouts, 2 * rollouts)
        return self.model_copy(update={"dataset_rollouts": rollouts, "queue_rollouts": queue})


@dataclass(frozen=True, slots=True)
class Queued:
    """An accepted rollout that waits for its update, or is in it."""

    header: Header
    rollout: Rollout


class Intake:
    """The learner's side of every rollout, from its arrival to its update."""

    def __init__(
        self, config: IntakeConfig, learner: LearnerState, snapshots: Iterable[AccountSnapshot] = ()
    ) -> None:
        self._config = config.for_actors(1)  # a size that is not worked out yet is one actor's
        self._learner_state = learner
        self._accounts = {(entry.actor, entry.incarnation): restored(entry) for entry in snapshots}
        self._queue: deque[Queued] = deque()
        self._in_update: tuple[Queued, ...] = ()

    @property
    def learner(self) -> LearnerState:
        """What the learner trains now."""
        return self._learner_state

    @property
    def queued(self) -> int:
        """Number of rollouts that wait for an update."""
        return len(self._queue)

    def arrive(self, header: Header, rollout: Rollout | None, now: float) -> Verdict:
        """Return the verdict on a rollout, which is queued if it is accepted.

        Args:
            header: Fields of the message that identify it.
            rollout: Its content; None only if ``header.fault`` says why.
            now: The caller's clock [s].
        """
        known = self._known(header)
        case = Case(
            header=header,
            learner=self._learner_state,
            is_known=known is not None,
            queued=len(self._queue),
            queue_limit=self._queue_limit(),
            version_at_use=self._version_at_use(),
            max_lag=self._config.max_lag,
        )
        kind, reason = judge(case)
        if (
            kind is VerdictKind.WRONG_RUN
        ):  # an actor of another run may have the name of one of ours: no account here
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
        """Return the answer to a payload whose sender can't be read: the sender tries again."""
        return self._verdict(VerdictKind.UNREADABLE, VerdictKind.UNREADABLE, reason)

    def report(self, report: ActorReport, now: float) -> Verdict:
        """Return new credits for an actor, which is alive unless it leaves or its liveliness token is gone.

        A liveliness loss may arrive before the actor's last report. The token of an actor that was only disconnected
        appears again, and then its reports count.
        """
        account = self._heard(report.actor, report.incarnation, now)
        account.hear(report, self._learner_state.generation)
        account.is_alive = not (report.leaving or account.is_out_of_sight)
        self._grant(account, now)
        return self._verdict(VerdictKind.CREDITS, VerdictKind.CREDITS, "", account.credit_limit)

    def gone(self, actor: str, incarnation: int) -> None:
        """Record that an actor died or left: its rollouts in flight are lost, its credits are free."""
        account = self._accounts.setdefault((actor, incarnation), Account(actor, incarnation))
        account.is_alive, account.is_out_of_sight = False, True

    def seen(self, actor: str, incarnation: int) -> None:
        """Record that an actor's token is present: after a loss, its rollouts in flight may arrive again."""
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

    def finish_update(self, learner: LearnerState) -> None:
        """Record the dataset as trained; waiting rollouts that the new version can't use are lost."""
        for entry in self._in_update:
            self._settle(entry, Fate.TRAINED)
        self._in_update = ()
        self._learner_state = learner
        waiting, self._queue = self._queue, deque()
        for entry in waiting:
            stays = entry.header.stage_number == learner.stage_number and (
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
        """Return how many sequence numbers are missing below the highest that arrived, over all actors."""
        return sum(account.gaps for account in self._accounts.values())

    def snapshots(self) -> tuple[AccountSnapshot, ...]:
        """Return what a checkpoint keeps, so that the next learner can tell a retry from a new rollout."""
        return tuple(account.snapshot() for account in self._accounts.values())

    def _settle(self, entry: Queued, fate: Fate) -> None:
        header = entry.header
        self._accounts[header.actor, header.incarnation].settle(header.sequence, fate)

    def _heard(self, actor: str, incarnation: int, now: float) -> Account:
        account = self._accounts.setdefault((actor, incarnation), Account(actor, incarnation))
        account.last_heard = now
        return account

    def _queue_limit(self) -> int:
        """Return how many rollouts may wait: no more than this stage will train on.

        A rollout after the last dataset of a stage would be accepted and then lost at the stage change.
        """
        datasets = self._learner_state.datasets_left - bool(self._in_update)
        return max(0, min(self._config.queue_rollouts, datasets * self._config.dataset_rollouts))

    def _version_at_use(self) -> int:
        datasets_before = len(self._queue) // self._config.dataset_rollouts + bool(self._in_update)
        return self._learner_state.version + datasets_before

    def _known(self, header: Header) -> Outcome | None:
        account = self._accounts.get((header.actor, header.incarnation))
        return None if account is None else account.outcome(header.sequence)

    def _verdict(self, kind: VerdictKind, first: VerdictKind, reason: str, credit_limit: int = 0) -> Verdict:
        learner = self._learner_state
        return Verdict(
            kind=kind,
            first=first,
            reason=reason,
            generation=learner.generation,
            version=learner.version,
            stage_number=learner.stage_number,
            stage=learner.stage,
            credit_limit=credit_limit,
            credit_version=learner.version,
        )

    def _grant(self, account: Account, now: float) -> None:
        """Raise the actor's limit as far as data is needed and its window allows."""
        wanted = self._wanted(now)
        room = self._config.window - self._outstanding(account)
        if account.is_alive and min(wanted, room) > 0:
            account.credit_limit = max(account.credit_limit, account.published) + min(wanted, room)

    def _wanted(self, now: float) -> int:
        """Return how many more rollouts of the present version are needed within the target lag."""
        # nothing is collected for the time after a stage change: it would be lost
        ahead = min(self._config.lag_aimed_at + 1, self._learner_state.datasets_left)
        datasets = ahead - bool(self._in_update)
        promised = sum(
            self._outstanding(account)
            for account in self._accounts.values()
            if account.is_alive and now - account.last_heard < self._config.credit_patience_s
        )
        return datasets * self._config.dataset_rollouts - len(self._queue) - promised

    def _outstanding(self, account: Account) -> int:
        """Return how many rollouts an actor may still send or has in flight."""
        return max(0, account.credit_limit - account.published) + account.missing
