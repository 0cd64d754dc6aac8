"""What the learners of a group do next: the same decision on every rank, from what each rank says.

A learner alone is a group of one. A turn costs an exchange of a few numbers, so a group decides before every dataset
who brings how much of it. A rank whose actors are few, slow or gone holds nobody up.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt


class Rank(NamedTuple):
    """What one rank says in a turn."""

    queued: int  # rollouts that wait for an update
    able: int  # actors that may bring rollouts
    active: int  # those of them that bring some, or have not been asked to yet
    ends: int  # 1: it must stop

    @classmethod
    def of(cls, row: npt.NDArray[np.int64]) -> Self:
        """Return what a rank said, from its row of numbers."""
        return cls(*(int(number) for number in row))


def taken(ranks: Sequence[Rank], dataset: int) -> tuple[int, ...]:
    """Return how many of its waiting rollouts each rank trains now; all 0 while too few wait.

    Args:
        ranks: What each rank says.
        dataset: Rollouts of a dataset.
    """
    counts = [0] * len(ranks)
    if sum(rank.queued for rank in ranks) < dataset:
        return tuple(counts)
    missing = dataset
    # First what each has asked its actors for, so that no rollout waits for a turn that was not meant for it. Then what
    # others lack: one of each in turn, so that the work is divided as evenly as it can be
    for most in (parts(ranks, dataset), [rank.queued for rank in ranks]):
        room = [min(limit, rank.queued) for limit, rank in zip(most, ranks, strict=True)]
        for _ in range(max(room)):
            for number, limit in enumerate(room):
                if missing and counts[number] < limit:
                    counts[number] += 1
                    missing -= 1
    return tuple(counts)


def parts(ranks: Sequence[Rank], dataset: int) -> tuple[int, ...]:
    """Return how many rollouts of a dataset each rank asks its actors for: by how many actors it has.

    They are one dataset together, by largest remainders: what is asked for beyond it waits, and grows too old. Those
    that bring nothing do not count. But a rank with any actor asks for one rollout: such an actor may be back.
    """
    active = sum(rank.active for rank in ranks)
    if not active:
        return (-(-dataset // len(ranks)),) * len(ranks)
    counts = [dataset * rank.active // active for rank in ranks]
    by_remainder = sorted(range(len(ranks)), key=lambda k: -(dataset * ranks[k].active % active))
    for number in by_remainder[: dataset - sum(counts)]:
        counts[number] += 1
    return tuple(max(count, min(rank.able, 1)) for count, rank in zip(counts, ranks, strict=True))
