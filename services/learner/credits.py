"""Which actors may send how many rollouts more.

Every verdict carries the number below which its actor may publish. The limits add up to the rollouts that are still
needed of the present version. So actors pause instead of playing rollouts that would be refused, which would favour
short episodes.

No actor can hold the credits that others need (ADR-0046). Only one with the learner's contract gets any. Those that
bring no new rollout for the patience count as free, whoever holds them. An actor whose rollouts are refused again and
again pauses.
"""

from typing import Final

from services.learner.ledger import Account

FREE_REFUSALS: Final = 2  # in a row: a stage change or a restart costs an actor as many as it has in flight
LONGEST_PAUSE_S: Final = 60.0  # without credits, after many refusals in a row


class Credits:
    """The promises to all actors.

    Args:
        window: Credits that one actor may hold.
        patience_s: Time without a new rollout after which an actor's credits go to others [s].
    """

    def __init__(self, window: int, patience_s: float) -> None:
        self._window, self._patience_s = window, patience_s
        self._promised = 0
        self._holders: dict[Account, int] = {}  # each one's part of it, by the time of its last progress

    def promised(self, now: float) -> int:
        """Return how many rollouts are promised by actors that have made progress lately, at ``now`` [s]."""
        while self._holders:
            account = next(iter(self._holders))  # those that have made no progress for longest are in front
            if now - account.last_progress < self._patience_s:
                break
            self._promised -= self._holders.pop(account)
        return self._promised

    def grant(self, account: Account, wanted: int, now: float) -> None:
        """Raise an actor's limit as far as ``wanted`` rollouts are not promised yet and its window allows."""
        self.recount(account, now)
        if not _may_have(account) or now < account.no_credits_before:
            return
        granted = min(wanted - self.promised(now), self._window - _outstanding(account))
        if granted > 0:
            account.credit_limit = max(account.credit_limit, account.published) + granted
            self.note_progress(account, now)

    def note_refusal(self, account: Account, now: float) -> None:
        """Record that an actor brought a rollout that was refused: after several in a row it pauses."""
        account.refused_in_a_row += 1
        account.no_credits_before = now + pause_after(account.refused_in_a_row)
        self.note_progress(account, now)

    def note_progress(self, account: Account, now: float) -> None:
        """Record that an actor got credits or brought a new rollout: its credits count from now."""
        account.last_progress = now
        self._promised -= self._holders.pop(account, 0)
        self.recount(account, now)

    def recount(self, account: Account, now: float) -> None:
        """Bring the part of an actor up to date, after a change of anything that it depends on."""
        is_fresh = now - account.last_progress < self._patience_s
        part = min(_outstanding(account), self._window) if _may_have(account) and is_fresh else 0
        self._promised += part - self._holders.get(account, 0)
        if part:
            self._holders[account] = part
        else:
            self._holders.pop(account, None)


def pause_after(refusals: int) -> float:
    """Return how long an actor gets no credits after so many refusals in a row [s]."""
    if refusals <= FREE_REFUSALS:
        return 0.0
    return min(2.0 ** min(refusals - FREE_REFUSALS, 32), LONGEST_PAUSE_S)


def _may_have(account: Account) -> bool:
    return account.is_alive and account.fits


def _outstanding(account: Account) -> int:
    """Return how many rollouts an actor may still send or has in flight."""
    return max(0, account.credit_limit - account.published) + account.missing
