"""Which rollouts wait for an update, the verdict on each, and how many more the learner needs.

It has state, but no network and no clock of its own, and it reads no array of a rollout.

Lag is counted to the version at use: each dataset queued before a rollout, and a running update, raise it by one. So an
accepted rollout never becomes too old while it waits. An actor without credits reports until it gets some, so that no
grant is lost for good.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from common.comms.budgets import one_line
from common.comms.messages import ActorReport, Rollout, Verdict, VerdictKind
from services.learner.accounts import Accounts, Life
from services.learner.admission import Case, Header, LearnerState, differs, judge
from services.learner.config import IntakeConfig
from services.learner.credits import Credits
from services.learner.ledger import Account, AccountSnapshot, Fate, Ledger, Outcome

# These are not recorded: the rollout has a verdict, or its actor sends it again.
_UNRECORDED: Final = frozenset({VerdictKind.DUPLICATE, VerdictKind.BUSY})

IDLE_REPORTS_HZ: Final = 16.0  # reports of all waiting actors together: 2 % of a core (benchmarks.idle)
SOONEST_REPORT_S: Final = 0.25  # pause between reports of a small fleet
LATEST_REPORT_S: Final = 64.0  # of one of more than 1,000 actors


@dataclass(frozen=True, slots=True)
class Queued:
    """An accepted rollout that waits for its update, or is in it."""

    header: Header
    rollout: Rollout


@dataclass(frozen=True, slots=True)
class Misfit:
    """A live actor whose task, network or experience are not the learner's."""

    actor: str
    incarnation: int
    training_hash: str


class Intake:
    """The learner's side of every rollout, from its arrival to its update.

    Args:
        config: How much data an update takes, and how old it may be.
        learner: What the learner trains now.
        snapshots: Accounts of a checkpoint.
        queue: Rollouts of a checkpoint that wait for an update.
        closed: Closed lives of actors, of a checkpoint: (actor, incarnation).
    """

    def __init__(
        self,
        config: IntakeConfig,
        learner: LearnerState,
        snapshots: Iterable[AccountSnapshot] = (),
        queue: Iterable[Queued] = (),
        closed: Iterable[Life] = (),
    ) -> None:
        self._config = config.for_actors(1)  # a size that is not worked out yet is one actor's
        # Rollouts that this learner brings into a dataset: all, unless it trains in a group
        self.part = self._config.dataset_rollouts
        self._learner_state = learner
        self._queue: deque[Queued] = deque(queue)
        kept: dict[Life, set[int]] = {}
        for entry in self._queue:
            kept.setdefault(entry.header.life, set()).add(entry.header.sequence)
        self._accounts = Accounts(snapshots, kept, closed)
        self._credits = Credits(config.window, config.credit_patience_s)
        self._in_update: tuple[Queued, ...] = ()
        self._is_updating = False
        self._now = 0.0
        self._misfits: dict[Life, Misfit] = {}
        self._new_misfits: list[Misfit] = []
        for entry in list(self._queue):
            self._drop_unfit(entry)

    @property
    def learner(self) -> LearnerState:
        """What the learner trains now."""
        return self._learner_state

    @property
    def queued(self) -> int:
        """Number of rollouts that wait for an update."""
        return len(self._queue)

    @property
    def waiting(self) -> tuple[Queued, ...]:
        """The rollouts that wait for an update, oldest first."""
        return tuple(self._queue)

    @property
    def closed(self) -> tuple[Life, ...]:
        """Closed lives of actors, for a checkpoint."""
        return self._accounts.closed

    @property
    def misfits(self) -> tuple[Misfit, ...]:
        """Live actors with another contract."""
        return tuple(self._misfits.values())

    @property
    def report_after_s(self) -> float:
        """Pause between two reports of a waiting actor [s]: all together send `IDLE_REPORTS_HZ`."""
        return min(max(SOONEST_REPORT_S, self._accounts.living / IDLE_REPORTS_HZ), LATEST_REPORT_S)

    def contributors(self, now: float) -> tuple[int, int]:
        """Return how many actors live that may bring rollouts, and how many of them do, at ``now`` [s].

        One that has credits and brings nothing for `credit_patience_s` hangs, or is far too slow.
        """
        patience = self._config.credit_patience_s
        able = [account for account in self._accounts.alive() if account.fits]
        active = sum(not a.credit_limit or now - a.last_progress < patience for a in able)
        return len(able), active

    def take_new_misfits(self) -> list[Misfit]:
        """Return the misfits that were found since the last call, each life of an actor once."""
        found, self._new_misfits = self._new_misfits, []
        return found

    def arrive(self, header: Header, rollout: Rollout | None, now: float) -> Verdict:
        """Return the verdict on a rollout, which is queued if it is accepted.

        Args:
            header: Fields of the message that identify it.
            rollout: Its content; None only if ``header.fault`` says why.
            now: The caller's clock [s].
        """
        self._now = now
        known, account = self._known(header), self._accounts.get(header.life)
        case = Case(
            header=header,
            learner=self._learner_state,
            is_known=known is not None,
            queued=len(self._queue),
            queue_limit=self._queue_limit(),
            version_at_use=self._version_at_use(),
            max_lag=self._config.max_lag,
            credit_end=(account.credit_limit if account else 0) + self._config.window,
        )
        kind, reason = judge(case)
        if kind is VerdictKind.WRONG_RUN:
            # An actor of another run may have the name of one of ours: no account here
            return self._verdict(kind, kind, reason)
        life = header.life
        if fault := self._fault(life, header.sequence):
            return self._verdict(VerdictKind.INVALID, VerdictKind.INVALID, fault)
        account = self._accounts.open(life)
        self._note_contract(account, header.training_hash)
        if kind is VerdictKind.ACCEPTED:
            if rollout is None:
                raise ValueError("a rollout without content needs a fault in its header")
            account.settle(header.sequence, Fate.QUEUED)
            self._queue.append(Queued(header, rollout))
            account.refused_in_a_row = 0
            self._credits.note_progress(account, now)
        elif kind not in _UNRECORDED:
            account.settle(header.sequence, kind)
            self._credits.note_refusal(account, now)
        first: VerdictKind = kind
        if kind is VerdictKind.DUPLICATE:
            first = known if isinstance(known, VerdictKind) else VerdictKind.ACCEPTED
        self._credits.grant(account, self._wanted(), now)
        return self._verdict(kind, first, reason, account.credit_limit)

    def unreadable(self, reason: str) -> Verdict:
        """Return the answer to a payload whose sender can't be read: the sender tries again."""
        return self._verdict(VerdictKind.UNREADABLE, VerdictKind.UNREADABLE, reason)

    def report(self, report: ActorReport, now: float) -> Verdict:
        """Return new credits for an actor, which is alive unless it leaves or its liveliness token is gone.

        A liveliness loss may arrive before the actor's last report. The token of an actor that was only disconnected
        appears again, and then its reports count.
        """
        self._now = now
        learner = self._learner_state
        life = (report.actor, report.incarnation)
        if ended := self._accounts.closed_reason(life):
            return self._verdict(VerdictKind.LIFE_ENDED, VerdictKind.LIFE_ENDED, ended)
        if fault := differs("run", report.run, learner.run) or self._fault(life, report.published):
            return self._verdict(VerdictKind.WRONG_RUN, VerdictKind.WRONG_RUN, fault)
        account = self._accounts.open(life)
        account.hear(report, learner.generation)
        self._set_alive(life, not (report.leaving or account.is_out_of_sight))
        self._note_contract(account, report.training_hash)
        self._credits.grant(account, self._wanted(), now)
        misfit = differs("training", report.training_hash or "of an older release", learner.training_hash)
        kind = VerdictKind.WRONG_CONTRACT if misfit else VerdictKind.CREDITS
        return self._verdict(kind, kind, misfit, account.credit_limit)

    def gone(self, actor: str, incarnation: int) -> None:
        """Record that an actor died or left: its rollouts in flight are lost, its credits are free."""
        life = (actor, incarnation)
        if self._accounts.is_closed(life) or self._accounts.make_room(life):
            return
        self._accounts.open(life).is_out_of_sight = True
        self._set_alive(life, False)

    def seen(self, actor: str, incarnation: int) -> None:
        """Record that an actor's token is present: after a loss, its rollouts in flight may arrive again."""
        account = self._accounts.get((actor, incarnation))
        if account is not None and account.is_out_of_sight:
            account.is_out_of_sight = False
            self._set_alive((actor, incarnation), True)

    def tidy(self, now: float) -> None:
        """Close the accounts of lives that ended long ago.

        An actor of a checkpoint that is not heard for `credit_patience_s` is dead.
        """
        self._now = now
        for life in self._accounts.overdue(now, self._config.credit_patience_s):
            self._set_alive(life, False)
        self._accounts.close_old(now)

    def take(self, count: int) -> tuple[Queued, ...]:
        """Return the oldest ``count`` rollouts, and start their update.

        Raises:
            RuntimeError: An update is running: `finish_update` must come first.
        """
        if self._is_updating:
            raise RuntimeError(f"an update of {len(self._in_update)} rollouts is running")
        self._in_update = tuple(self._queue.popleft() for _ in range(count))
        self._is_updating = True
        return self._in_update

    def finish_update(self, learner: LearnerState) -> tuple[Queued, ...]:
        """Record the dataset as trained; return the waiting rollouts that the new version can't use: they are lost."""
        for entry in self._in_update:
            self._settle(entry, Fate.TRAINED)
        self._in_update, self._is_updating = (), False
        self._learner_state = learner
        waiting, self._queue = self._queue, deque()
        lost = []
        for entry in waiting:
            stays = entry.header.stage_number == learner.stage_number and (
                self._version_at_use() - entry.header.version <= self._config.max_lag
            )
            if stays:
                self._queue.append(entry)
            else:
                self._settle(entry, Fate.LOST)
                lost.append(entry)
        return tuple(lost)

    def ledgers(self) -> dict[Life, Ledger]:
        """Return the ledger of every life of every actor."""
        return self._accounts.ledgers()

    def total(self) -> Ledger:
        """Return the ledger of all accounts together."""
        return self._accounts.total()

    def gaps(self) -> int:
        """Return how many sequence numbers are missing below the highest that arrived, over all actors."""
        return self._accounts.gaps()

    def snapshots(self) -> tuple[AccountSnapshot, ...]:
        """Return what a checkpoint keeps, so that the next learner can tell a retry from a new rollout."""
        return self._accounts.snapshots()

    # ---- actors

    def _fault(self, life: Life, number: int) -> str:
        """Return why a message of this life with this number counts for nothing, or ""."""
        accounts = self._accounts
        return accounts.closed_reason(life) or accounts.jump_reason(life, number) or accounts.make_room(life)

    def _set_alive(self, life: Life, is_alive: bool) -> None:
        account = self._accounts.set_alive(life, is_alive, self._now)
        if not is_alive:
            self._misfits.pop(life, None)
        self._credits.recount(account, self._now)

    def _note_contract(self, account: Account, training_hash: str) -> None:
        """Remember what the actor plays; another task, network or experience is a misfit."""
        account.fits = training_hash == self._learner_state.training_hash
        life = (account.actor, account.incarnation)
        if account.fits or not account.is_alive:
            self._misfits.pop(life, None)
            return
        misfit = Misfit(*life, training_hash)
        if life not in self._misfits:
            self._new_misfits.append(misfit)
        self._misfits[life] = misfit

    def _settle(self, entry: Queued, fate: Outcome) -> None:
        self._accounts.settle(entry.header.life, entry.header.sequence, fate)

    def _drop_unfit(self, entry: Queued) -> None:
        """Drop a rollout of a checkpoint that the present settings can't train on."""
        header, learner = entry.header, self._learner_state
        if header.training_hash != learner.training_hash:
            self._settle(entry, VerdictKind.WRONG_CONTRACT)
        elif header.stage_number != learner.stage_number:
            self._settle(entry, VerdictKind.STALE_STAGE)
        else:
            return
        self._queue.remove(entry)

    # ---- verdicts

    def _queue_limit(self) -> int:
        """Return how many rollouts may wait: no more than this stage will train on.

        A rollout after the last dataset of a stage would be accepted and then lost at the stage change.
        """
        datasets = self._learner_state.datasets_left - self._is_updating
        return max(0, min(self._config.queue_rollouts, datasets * self.part))

    def _version_at_use(self) -> int:
        whole = len(self._queue) // self.part if self.part else 0
        datasets_before = whole + self._is_updating
        return self._learner_state.version + datasets_before

    def _known(self, header: Header) -> Outcome | None:
        account = self._accounts.get(header.life)
        return None if account is None else account.outcome(header.sequence)

    def _verdict(self, kind: VerdictKind, first: VerdictKind, reason: str, credit_limit: int = 0) -> Verdict:
        learner = self._learner_state
        return Verdict(
            kind=kind,
            first=first,
            reason=one_line(reason),
            generation=learner.generation,
            version=learner.version,
            stage_number=learner.stage_number,
            stage=learner.stage,
            credit_limit=credit_limit,
            credit_version=learner.version,
            report_after_s=self.report_after_s,
        )

    def _wanted(self) -> int:
        """Return how many more rollouts of the present version are needed within the target lag."""
        # nothing is collected for the time after a stage change: it would be lost
        ahead = min(self._config.lag_aimed_at + 1, self._learner_state.datasets_left)
        datasets = ahead - self._is_updating
        return datasets * self.part - len(self._queue)
