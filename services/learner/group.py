"""A group of learners that train one policy together: data-parallel, over torch.distributed.

Every rank has the same network, optimiser and random state, and the rollouts of its own actors. The dataset of an epoch
is the rollouts of all ranks, in the order of ranks. A minibatch is drawn from the whole dataset. Each rank computes the
part of its gradient that belongs to its own frames, and the parts are summed. So the ranks' parameters stay equal, and
they are those of one learner that has all the rollouts, up to the rounding of sums.

torchrun starts the ranks and says in the environment who they are (RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT).
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
import torch.distributed
from torch import Tensor

from common.errors import ReportedError

TIMEOUT: Final = timedelta(seconds=60)  # a rank that is silent for so long has died, and the group ends


class GroupError(ReportedError):
    """The environment does not say which rank this process is."""


@dataclass(frozen=True, slots=True)
class Group:
    """The ranks of one training; by default a learner alone."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this rank publishes, saves and logs for the group."""
        return self.rank == 0

    def add(self, values: Tensor) -> None:
        """Replace ``values`` by their sum over the ranks, the same bits on each."""
        if self.size > 1:
            torch.distributed.all_reduce(values)

    def gathered(self, array: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        """Return every rank's array (n, ...), in the order of ranks; n may differ from rank to rank."""
        if self.size == 1:
            return [array]
        own = torch.from_numpy(np.ascontiguousarray(array))
        counts = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        torch.distributed.all_gather(counts, torch.tensor([len(own)]))
        longest = max(int(count) for count in counts)
        padded = own.new_zeros((longest, *own.shape[1:]))
        padded[: len(own)] = own
        rows = [torch.empty_like(padded) for _ in range(self.size)]
        torch.distributed.all_gather(rows, padded)
        return [part[: int(count)].numpy() for part, count in zip(rows, counts, strict=True)]

    def leave(self) -> None:
        """Close the connections to the other ranks."""
        if self.size > 1:
            torch.distributed.destroy_process_group()


ALONE: Final = Group()


def join(environment: Mapping[str, str] = os.environ, backend: str = "gloo") -> Group:
    """Return the group that torchrun has put this process into; ``ALONE`` without torchrun.

    Raises:
        GroupError: The environment is incomplete, or the other ranks do not come.
    """
    if "WORLD_SIZE" not in environment:
        return ALONE
    try:
        rank, size = int(environment["RANK"]), int(environment["WORLD_SIZE"])
    except (KeyError, ValueError):
        raise GroupError(
            f"WORLD_SIZE {environment['WORLD_SIZE']!r} with RANK {environment.get('RANK')!r}; allowed: two whole "
            "numbers, as torchrun sets them"
        ) from None
    if size == 1:
        return ALONE
    try:
        torch.distributed.init_process_group(backend, rank=rank, world_size=size, timeout=TIMEOUT)
    except (ValueError, RuntimeError) as error:
        raise GroupError(f"rank {rank} of {size} found no group: {error}") from None
    return Group(rank, size)
