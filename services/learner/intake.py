"""Which rollouts wait for an update, the verdict on each, and how many more the learner needs.

It has state, but no network and no clock of its own, and it reads no array of a rollout.

Lag is counted to the version at use: each dataset queued before a rollout, and a running update, raise it by one. So an
accepted rollout never becomes too old while it waits.

Pacing: every verdict carries the number below which its actor may publish. The limits add up to the rollouts that are
still needed of the present version. So actors pause instead of playing rollouts that would be refused, which would
favour short episodes. An actor without credits reports until it gets some, so that no grant is lost for good.

No actor can hold the credits that others need (ADR-0046). Only an actor with the learner's contract gets any. Those
that bring no new rollout for `credit_patience_s` count as free, whoever holds them. An actor whose rollouts are refused
again and again pauses. The cost of a report does not depend on the number of accounts: all sums are kept up to date.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from common.comms.budgets import one_line
from common.comms.messages import ActorReport, Rollout, Verdict, VerdictKind
from services.learner.admission import Case, Header, LearnerState, differs, judge
from services.learner.config import IntakeConfig
from services.learner.ledger import Account, AccountSnapshot, Fate, Ledger, Outcome, folded, restored

# These are not recorded: the rollout has a verdict, or its actor sends it again.
_UNRECORDED: Final = frozenset({VerdictKind.DUPLICATE, VerdictKind.BUSY})

IDLE_REPORTS_HZ: Final = 16.0  # reports of all waiting actors together: 2 % of a core (benchmarks.idle)
SOONEST_REPORT_S: Final = 0.25  # pause between reports of a small fleet
LATEST_REPORT_S: Final = 64.0  # of one of more than 1,000 actors
FREE_REFUSALS: Final = 2  # in a row: a stage change or a restart costs an actor as many as it has in flight
LONGEST_PAUSE_S: Final = 60.0  # without credits, after many refusals in a row
FOLD_AFTER_S: Final = 600.0  # a life that a newer one of the same actor has replaced
FOLD_LAST_AFTER_S: Final = 86_400.0  # the last life of an actor: by then it has dropped what it had in flight
MOST_ACCOUNTS: Final = 16_384  # a new one beyond closes a dead one early, or is refused
LIVES_KEPT: Final = 4096  # closed lives whose late messages are told from those of new ones

# How far the numbers of a known life may go on in one message
BEYOND_CREDITS: Final = 64  # more than any window: from what this learner granted
LONGEST_JUMP: Final = 65_536  # more than any outage takes: from what an earlier learner may have granted

EARLIER: Final = ("", 0)  # the account of all closed lives


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


_Key = tuple[str, int]  # actor, incarnation


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
        closed: Iterable[tuple[str, int]] = (),
    ) -> None:
        self._config = config.for_actors(1)  # a size that is not worked out yet is one actor's
        self._learner_state = learner
        self._queue: deque[Queued] = deque(queue)
        kept: dict[_Key, set[int]] = {}
        for entry in self._queue:
            kept.setdefault(entry.header.life, set()).add(entry.header.sequence)
        self._accounts: dict[_Key, Account] = {}
        self._in_update: tuple[Queued, ...] = ()
        self._now = 0.0
        self._closed = dict.fromkeys(closed)  # in order of closing
        # Sums over all accounts, kept up to date
        self._total = Ledger()
        self._gaps = 0
        # Each account's changes at the last sum, and its parts of total and gaps
        self._summed: dict[_Key, tuple[int, Ledger, int]] = {}
        self._changed: set[_Key] = set()
        self._promised = 0
        self._holders: dict[_Key, int] = {}  # each one's part of it, by the time of its last progress
        self._living: set[_Key] = set()
        self._misfits: dict[_Key, Misfit] = {}
        self._new_misfits: list[Misfit] = []
        self._newest: dict[str, int] = {}  # the life of each actor that was heard of last
        self._dead_since: dict[_Key, float] = {}  # [s], oldest first
        self._awaited: dict[_Key, float] = {}  # accounts of a checkpoint, until their actors are heard
        for memory in snapshots:
            key = (memory.actor, memory.incarnation)
            self._accounts[key] = restored(memory, kept.get(key, frozenset()))
            if key == EARLIER:
                self._accounts[key].is_alive = False
            else:
                self._awaited[key] = -1.0
            self._newest[key[0]] = key[1]
            self._changed.add(key)
        for key in kept.keys() - self._accounts.keys():
            raise ValueError(f"{len(kept[key])} rollouts wait of {key}, which has no account")
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
    def closed(self) -> tuple[tuple[str, int], ...]:
        """Closed lives of actors, for a checkpoint."""
        return tuple(self._closed)

    @property
    def misfits(self) -> tuple[Misfit, ...]:
        """Live actors with another contract."""
        return tuple(self._misfits.values())

    @property
    def report_after_s(self) -> float:
        """Pause between two reports of a waiting actor [s]: all together send `IDLE_REPORTS_HZ`."""
        return min(max(SOONEST_REPORT_S, len(self._living) / IDLE_REPORTS_HZ), LATEST_REPORT_S)

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
        key = header.life
        if self._is_closed(key):
            return self._verdict(VerdictKind.INVALID, VerdictKind.INVALID, _closed_reason(key))
        if fault := self._jump_fault(key, header.sequence) or self._no_room(key):
            return self._verdict(VerdictKind.INVALID, VerdictKind.INVALID, fault)
        account = self._account(key)
        self._note_contract(key, account, header.training_hash)
        if kind is VerdictKind.ACCEPTED:
            if rollout is None:
                raise ValueError("a rollout without content needs a fault in its header")
            account.settle(header.sequence, Fate.QUEUED)
            self._queue.append(Queued(header, rollout))
            account.refused_in_a_row = 0
            self._progress(key, account)
        elif kind not in _UNRECORDED:
            account.settle(header.sequence, kind)
            account.refused_in_a_row += 1
            account.no_credits_before = now + pause_after(account.refused_in_a_row)
            self._progress(key, account)
        first: VerdictKind = kind
        if kind is VerdictKind.DUPLICATE:
            first = known if isinstance(known, VerdictKind) else VerdictKind.ACCEPTED
        self._grant(key, account)
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
        key = (report.actor, report.incarnation)
        fault = (
            differs("run", report.run, learner.run)
            or (_closed_reason(key) if self._is_closed(key) else "")
            or self._jump_fault(key, report.published)
            or self._no_room(key)
        )
        if fault:
            return self._verdict(VerdictKind.WRONG_RUN, VerdictKind.WRONG_RUN, fault)
        account = self._account(key)
        account.hear(report, learner.generation)
        self._set_alive(key, account, not (report.leaving or account.is_out_of_sight))
        self._note_contract(key, account, report.training_hash)
        self._grant(key, account)
        misfit = differs("training", report.training_hash or "of an older release", learner.training_hash)
        kind = VerdictKind.WRONG_CONTRACT if misfit else VerdictKind.CREDITS
        return self._verdict(kind, kind, misfit, account.credit_limit)

    def gone(self, actor: str, incarnation: int) -> None:
        """Record that an actor died or left: its rollouts in flight are lost, its credits are free."""
        key = (actor, incarnation)
        if self._is_closed(key) or self._no_room(key):
            return
        account = self._account(key)
        account.is_out_of_sight = True
        self._set_alive(key, account, False)

    def seen(self, actor: str, incarnation: int) -> None:
        """Record that an actor's token is present: after a loss, its rollouts in flight may arrive again."""
        account = self._accounts.get((actor, incarnation))
        if account is not None and account.is_out_of_sight:
            account.is_out_of_sight = False
            self._set_alive((actor, incarnation), account, True)

    def tidy(self, now: float) -> None:
        """Close the accounts of lives that ended long ago: their counts go to one account of all earlier lives.

        An actor of a checkpoint that is not heard for `credit_patience_s` is dead.
        """
        self._now = now
        for key, since in list(self._awaited.items()):
            if since < 0:
                self._awaited[key] = now
            elif now - since > self._config.credit_patience_s:
                self._set_alive(key, self._accounts[key], False)
        for key, since in list(self._dead_since.items()):
            if now - since <= FOLD_AFTER_S:
                break
            is_replaced = self._newest.get(key[0]) != key[1]  # no clock says which life is newer
            if self._accounts[key].queued or not (is_replaced or now - since > FOLD_LAST_AFTER_S):
                continue
            self._close(key)

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

    def finish_update(self, learner: LearnerState) -> tuple[Queued, ...]:
        """Record the dataset as trained; return the waiting rollouts that the new version can't use: they are lost."""
        for entry in self._in_update:
            self._settle(entry, Fate.TRAINED)
        self._in_update = ()
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

    def ledgers(self) -> dict[tuple[str, int], Ledger]:
        """Return the account of every (actor, incarnation)."""
        return {key: account.ledger() for key, account in self._accounts.items()}

    def total(self) -> Ledger:
        """Return the ledger of all accounts together; only those that have changed are read."""
        for key in self._changed:
            account = self._accounts.get(key)
            changes, before, gaps = self._summed.pop(key, (-1, Ledger(), 0))
            if account is None:
                self._total, self._gaps = self._total - before, self._gaps - gaps
                continue
            if changes != account.changes:
                after = account.ledger()
                self._total, self._gaps = self._total - before + after, self._gaps - gaps + account.gaps
                changes, before, gaps = account.changes, after, account.gaps
            self._summed[key] = (changes, before, gaps)
        self._changed.clear()
        return self._total

    def gaps(self) -> int:
        """Return how many sequence numbers are missing below the highest that arrived, over all actors."""
        self.total()
        return self._gaps

    def snapshots(self) -> tuple[AccountSnapshot, ...]:
        """Return what a checkpoint keeps, so that the next learner can tell a retry from a new rollout."""
        return tuple(account.snapshot() for account in self._accounts.values())

    # ---- accounts

    def _account(self, key: _Key) -> Account:
        """Return the account of one life of an actor, which has sent a message or lost its token."""
        self._awaited.pop(key, None)
        self._changed.add(key)
        if key not in self._accounts:
            self._accounts[key] = Account(*key)
            self._newest[key[0]] = key[1]
        account = self._accounts[key]
        if account.is_alive:
            self._living.add(key)
        return account

    def _set_alive(self, key: _Key, account: Account, is_alive: bool) -> None:
        self._awaited.pop(key, None)
        self._changed.add(key)
        account.is_alive = is_alive
        if is_alive:
            self._living.add(key)
            self._dead_since.pop(key, None)
        else:
            self._living.discard(key)
            self._misfits.pop(key, None)
            self._dead_since.setdefault(key, self._now)
        self._recount(key, account)

    def _is_closed(self, key: _Key) -> bool:
        return key in self._closed

    def _no_room(self, key: _Key) -> str:
        """Return why a new life gets no account, or ""; a dead one's is closed for it."""
        if key in self._accounts or len(self._accounts) < MOST_ACCOUNTS:
            return ""
        dead = next((old for old in self._dead_since if not self._accounts[old].queued), None)
        if dead is None:
            return f"actor {key[0]} is one too many; allowed: {MOST_ACCOUNTS} with an account"
        self._close(dead)
        return ""

    def _jump_fault(self, key: _Key, number: int) -> str:
        """Return why a number can't be of this life of an actor, or ""; the first number may be any."""
        account = self._accounts.get(key)
        if account is None or key in self._awaited or not account.published:
            return ""
        jump = BEYOND_CREDITS if account.credit_limit else LONGEST_JUMP
        most = max(account.published, account.credit_limit) + jump
        return "" if number <= most else f"number {number}; allowed: up to {most}"

    def _close(self, key: _Key) -> None:
        """Add the account of a dead life to that of all earlier lives."""
        earlier = self._accounts.get(EARLIER) or Account(*EARLIER)
        self._accounts[EARLIER] = folded(earlier, self._accounts.pop(key))
        self._summed[EARLIER] = (-1, *self._summed.pop(EARLIER, (-1, Ledger(), 0))[1:])
        self._changed |= {key, EARLIER}
        self._dead_since.pop(key, None)
        self._closed[key] = None
        while len(self._closed) > LIVES_KEPT:
            del self._closed[next(iter(self._closed))]
        if self._newest.get(key[0]) == key[1]:
            del self._newest[key[0]]

    def _note_contract(self, key: _Key, account: Account, training_hash: str) -> None:
        """Remember what the actor plays; another task, network or experience is a misfit."""
        account.training_hash = training_hash
        if self._fits(account) or not account.is_alive:
            self._misfits.pop(key, None)
            return
        misfit = Misfit(*key, training_hash)
        if key not in self._misfits:
            self._new_misfits.append(misfit)
        self._misfits[key] = misfit

    def _fits(self, account: Account) -> bool:
        """Return whether the actor has the learner's contract."""
        return account.training_hash == self._learner_state.training_hash

    def _settle(self, entry: Queued, fate: Outcome) -> None:
        key = entry.header.life
        self._changed.add(key)
        self._accounts[key].settle(entry.header.sequence, fate)

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
        datasets = self._learner_state.datasets_left - bool(self._in_update)
        return max(0, min(self._config.queue_rollouts, datasets * self._config.dataset_rollouts))

    def _version_at_use(self) -> int:
        datasets_before = len(self._queue) // self._config.dataset_rollouts + bool(self._in_update)
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

    # ---- credits

    def _grant(self, key: _Key, account: Account) -> None:
        """Raise the actor's limit as far as data is needed and its window allows."""
        self._recount(key, account)
        if not (account.is_alive and self._fits(account)) or self._now < account.no_credits_before:
            return
        granted = min(self._wanted(), self._config.window - _outstanding(account))
        if granted > 0:
            account.credit_limit = max(account.credit_limit, account.published) + granted
            self._progress(key, account)

    def _progress(self, key: _Key, account: Account) -> None:
        """Record that the actor got credits or brought a new rollout: its credits count from now."""
        account.last_progress = self._now
        self._promised -= self._holders.pop(key, 0)
        self._recount(key, account)

    def _recount(self, key: _Key, account: Account) -> None:
        """Bring the actor's part of the promised rollouts up to date."""
        is_fresh = self._now - account.last_progress < self._config.credit_patience_s
        part = 0
        if account.is_alive and self._fits(account) and is_fresh:
            part = min(_outstanding(account), self._config.window)
        self._promised += part - self._holders.get(key, 0)
        if part:
            self._holders[key] = part
        else:
            self._holders.pop(key, None)

    def _wanted(self) -> int:
        """Return how many more rollouts of the present version are needed within the target lag."""
        while self._holders:  # those that have made no progress for long are in front
            key = next(iter(self._holders))
            if self._now - self._accounts[key].last_progress < self._config.credit_patience_s:
                break
            self._promised -= self._holders.pop(key)
        # nothing is collected for the time after a stage change: it would be lost
        ahead = min(self._config.lag_aimed_at + 1, self._learner_state.datasets_left)
        datasets = ahead - bool(self._in_update)
        return datasets * self._config.dataset_rollouts - len(self._queue) - self._promised


def pause_after(refusals: int) -> float:
    """Return how long an actor gets no credits after so many refusals in a row [s]."""
    if refusals <= FREE_REFUSALS:
        return 0.0
    return min(2.0 ** min(refusals - FREE_REFUSALS, 32), LONGEST_PAUSE_S)


def _outstanding(account: Account) -> int:
    """Return how many rollouts an actor may still send or has in flight."""
    return max(0, account.credit_limit - account.published) + account.missing


def _closed_reason(key: _Key) -> str:
    return f"life {key[1]} of actor {key[0]} ended, and its account is closed: start the actor again"
