"""The exchanges of a group of learners outside its updates. Every rank makes the same calls in the same order."""

import json
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from common.comms.codec import encode
from common.comms.messages import FATES
from services.learner.group import Group
from services.learner.intake import Intake, Queued
from services.learner.telemetry import fates
from services.learner.turns import Rank, parts, taken

SOON_S: Final = 0.001  # longest wait between two looks for the other ranks
RECOUNT_S: Final = 0.5  # time between two looks at which actors bring rollouts


class Lockstep:
    """One rank's part in the turns of its group; of a learner alone it decides the same, without an exchange.

    Args:
        group: The ranks.
        dataset: Rollouts of a dataset, over all ranks.
        wait: Waits so many seconds at most, until a message arrives.
    """

    def __init__(self, group: Group, dataset: int, wait: Callable[[float], object]) -> None:
        self.group, self._dataset, self._wait = group, dataset, wait
        self._contributors, self._next_count = (0, 0), 0.0
        self.fates = dict.fromkeys(FATES, 0)  # the ledger of all ranks, as of the last turn
        self.queued = 0  # rollouts that wait on all ranks

    def turn(
        self, intake: Intake, now: float, ends: bool, serve: Callable[[], None]
    ) -> tuple[tuple[Queued, ...], bool, bool]:
        """Return this rank's rollouts of the next dataset, whether there is one, and whether the group ends.

        Args:
            intake: Of this rank.
            now: The caller's clock [s].
            ends: Whether this rank must stop.
            serve: Answers this rank's actors; called again and again until the other ranks have come.
        """

        def on_tick() -> None:
            serve()
            self._wait(SOON_S)

        if now >= self._next_count:
            self._contributors, self._next_count = intake.contributors(now), now + RECOUNT_S
        mine = fates(intake.total())
        row = [intake.queued, *self._contributors, ends, *mine.values()]
        rows = np.array([own for (own,) in self.group.gathered(np.array(row, np.int64), on_tick=on_tick)])
        ranks = [Rank.of(row[:4]) for row in rows]
        self.fates = dict(zip(mine, (int(sum_) for sum_ in rows[:, 4:].sum(0)), strict=True))
        self.queued = sum(rank.queued for rank in ranks)
        intake.part = parts(ranks, self._dataset)[self.group.rank]
        counts = taken(ranks, self._dataset)
        if any(rank.ends for rank in ranks) or not any(counts):
            return (), False, any(rank.ends for rank in ranks)
        return intake.take(counts[self.group.rank]), True, False

    def agrees(self, leaders: bool) -> bool:
        """Return what the leader has decided; the argument of the other ranks does not count."""
        return bool(self.group.of_leader(b"1" if leaders else b""))

    def collected(self, intake: Intake, keeps_queue: bool) -> dict[str, Any]:
        """Return accounts, closed lives and waiting rollouts of all ranks, for a checkpoint.

        Args:
            intake: Of this rank.
            keeps_queue: Whether rollouts that wait are kept; otherwise they are lost with this process.
        """
        queue = tuple(encode(entry.rollout) for entry in intake.waiting) if keeps_queue else ()
        if self.group.size == 1:
            accounts = [entry.to_json() for entry in intake.snapshots()]
            return {"accounts": accounts, "closed": intake.closed, "queue": queue}
        text = json.dumps([[asdict(entry) for entry in intake.snapshots()], intake.closed])
        ranks = self.group.gathered_bytes([text.encode(), *queue])
        told = [json.loads(items[0]) for items in ranks]
        return {
            "accounts": [account for accounts, _ in told for account in accounts],
            "closed": tuple((actor, life) for _, closed in told for actor, life in closed),
            "queue": tuple(rollout for items in ranks for rollout in items[1:]),
        }
