"""The accounts of all actors: one for each life of an actor, which are open, and their sums.

Lives that ended long ago share one account, so memory is bounded, and the cost of a message does not depend on the
number of accounts: all sums are kept up to date.
"""

from collections.abc import Iterable, Mapping, Set
from typing import Final

from services.learner.ledger import Account, AccountSnapshot, Ledger, Outcome, folded, restored

FOLD_AFTER_S: Final = 600.0  # a life that a newer one of the same actor has replaced
FOLD_LAST_AFTER_S: Final = 86_400.0  # the last life of an actor: by then it has dropped what it had in flight
MOST_ACCOUNTS: Final = 16_384  # a new one beyond closes a dead one early, or is refused
LIVES_KEPT: Final = 4096  # closed lives whose late messages are told from those of new ones

# How far the numbers of a known life may go on in one message
BEYOND_CREDITS: Final = 64  # more than any window: from what this learner granted
LONGEST_JUMP: Final = 65_536  # more than any outage takes: from what an earlier learner may have granted

Life = tuple[str, int]  # actor, incarnation

EARLIER: Final[Life] = ("", 0)  # the account of all closed lives


class Accounts:
    """What is known of every actor.

    Args:
        snapshots: Accounts of a checkpoint. Until their actors are heard, they are awaited.
        queued: Numbers of the rollouts that the checkpoint holds, by life.
        closed: Closed lives of a checkpoint.

    Raises:
        ValueError: A rollout waits of a life that has no account.
    """

    def __init__(
        self, snapshots: Iterable[AccountSnapshot], queued: Mapping[Life, Set[int]], closed: Iterable[Life]
    ) -> None:
        self._accounts: dict[Life, Account] = {}
        self._closed = dict.fromkeys(closed)  # in order of closing
        self._living: set[Life] = set()
        self._newest: dict[str, int] = {}  # the life of each actor that was heard of last
        self._dead_since: dict[Life, float] = {}  # [s], oldest first
        self._awaited: dict[Life, float | None] = {}  # accounts of a checkpoint, and since when [s]
        self._total = Ledger()
        self._gaps = 0
        # Each account's changes at the last sum, and its parts of total and gaps
        self._summed: dict[Life, tuple[int, Ledger, int]] = {}
        self._changed: set[Life] = set()
        for memory in snapshots:
            life = (memory.actor, memory.incarnation)
            account = restored(memory, queued.get(life, frozenset()))
            if life == EARLIER:
                if life in self._accounts:  # each learner of a group has kept one
                    account = folded(self._accounts[life], account)
                account.is_alive = False
            else:
                self._awaited[life] = None
            self._accounts[life] = account
            self._newest[life[0]] = life[1]
            self._changed.add(life)
        for life in queued.keys() - self._accounts.keys():
            raise ValueError(f"{len(queued[life])} rollouts wait of {life}, which has no account")

    @property
    def living(self) -> int:
        """How many lives there are now."""
        return len(self._living)

    @property
    def closed(self) -> tuple[Life, ...]:
        """Closed lives, oldest first."""
        return tuple(self._closed)

    def alive(self) -> list[Account]:
        """Return the accounts of all lives that there are now."""
        return [self._accounts[life] for life in self._living]

    def get(self, life: Life) -> Account | None:
        """Return the account of a life, or None."""
        return self._accounts.get(life)

    def open(self, life: Life) -> Account:
        """Return the account of a life, which has sent a message or lost its token."""
        self._awaited.pop(life, None)
        self._changed.add(life)
        if life not in self._accounts:
            self._accounts[life] = Account(*life)
            self._newest[life[0]] = life[1]
        account = self._accounts[life]
        if account.is_alive:
            self._living.add(life)
        return account

    def set_alive(self, life: Life, is_alive: bool, now: float) -> Account:
        """Record whether an actor that has an account lives, at ``now`` [s]; return the account."""
        self._awaited.pop(life, None)
        self._changed.add(life)
        account = self._accounts[life]
        account.is_alive = is_alive
        if is_alive:
            self._living.add(life)
            self._dead_since.pop(life, None)
        else:
            self._living.discard(life)
            self._dead_since.setdefault(life, now)
        return account

    def settle(self, life: Life, sequence: int, outcome: Outcome) -> None:
        """Record the outcome of a rollout; a final outcome does not change."""
        self._changed.add(life)
        self._accounts[life].settle(sequence, outcome)

    def is_closed(self, life: Life) -> bool:
        """Return whether the life ended, and its account is part of that of all earlier lives."""
        return life in self._closed

    def closed_reason(self, life: Life) -> str:
        """Return why a closed life is not heard, or ""."""
        if not self.is_closed(life):
            return ""
        return f"life {life[1]} of actor {life[0]} ended, and its account is closed: start the actor again"

    def jump_reason(self, life: Life, number: int) -> str:
        """Return why a number can't be of this life of an actor, or ""; the first number may be any."""
        account = self._accounts.get(life)
        if account is None or life in self._awaited or not account.published:
            return ""
        jump = BEYOND_CREDITS if account.credit_limit else LONGEST_JUMP
        most = max(account.published, account.credit_limit) + jump
        return "" if number <= most else f"number {number}; allowed: up to {most}"

    def make_room(self, life: Life) -> str:
        """Close a dead life's account where a new one would be one too many; return why there is no room, or ""."""
        if life in self._accounts or len(self._accounts) < MOST_ACCOUNTS:
            return ""
        dead = next((old for old in self._dead_since if not self._accounts[old].queued), None)
        if dead is None:
            return f"actor {life[0]} is one too many; allowed: {MOST_ACCOUNTS} with an account"
        self._close(dead)
        return ""

    def overdue(self, now: float, patience_s: float) -> list[Life]:
        """Return the actors of a checkpoint that were awaited for longer than the patience."""
        found = []
        for life, since in self._awaited.items():
            if since is None:
                self._awaited[life] = now
            elif now - since > patience_s:
                found.append(life)
        return found

    def close_old(self, now: float) -> None:
        """Close the accounts of lives that ended long ago: their counts go to one account of all earlier lives."""
        for life, since in list(self._dead_since.items()):
            if now - since <= FOLD_AFTER_S:
                break
            is_replaced = self._newest.get(life[0]) != life[1]  # no clock says which life is newer
            if not self._accounts[life].queued and (is_replaced or now - since > FOLD_LAST_AFTER_S):
                self._close(life)

    def ledgers(self) -> dict[Life, Ledger]:
        """Return the ledger of each account."""
        return {life: account.ledger() for life, account in self._accounts.items()}

    def total(self) -> Ledger:
        """Return the ledger of all accounts together; only those that have changed are read."""
        for life in self._changed:
            account = self._accounts.get(life)
            changes, before, gaps = self._summed.pop(life, (-1, Ledger(), 0))
            if account is None:
                self._total, self._gaps = self._total - before, self._gaps - gaps
                continue
            if changes != account.changes:
                after = account.ledger()
                self._total, self._gaps = self._total - before + after, self._gaps - gaps + account.gaps
                changes, before, gaps = account.changes, after, account.gaps
            self._summed[life] = (changes, before, gaps)
        self._changed.clear()
        return self._total

    def gaps(self) -> int:
        """Return how many sequence numbers are missing below the highest that arrived, over all actors."""
        self.total()
        return self._gaps

    def snapshots(self) -> tuple[AccountSnapshot, ...]:
        """Return what a checkpoint keeps, so that the next learner can tell a retry from a new rollout."""
        return tuple(account.snapshot() for account in self._accounts.values())

    def _close(self, life: Life) -> None:
        """Add the account of a dead life to that of all earlier lives."""
        earlier = self._accounts.get(EARLIER) or Account(*EARLIER)
        self._accounts[EARLIER] = folded(earlier, self._accounts.pop(life))
        self._summed[EARLIER] = (-1, *self._summed.pop(EARLIER, (-1, Ledger(), 0))[1:])
        self._changed |= {life, EARLIER}
        self._dead_since.pop(life, None)
        self._closed[life] = None
        while len(self._closed) > LIVES_KEPT:
            del self._closed[next(iter(self._closed))]
        if self._newest.get(life[0]) == life[1]:
            del self._newest[life[0]]
