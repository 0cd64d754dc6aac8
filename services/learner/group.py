"""A group of learners that train one policy together: data-parallel, over torch.distributed.

Every rank has the same network, optimiser and random state, and the rollouts of its own actors. The dataset of an epoch
is the rollouts of all ranks, in the order of ranks. A minibatch is drawn from the whole dataset. Each rank computes the
part of its gradient that belongs to its own frames, and the parts are summed. So the ranks' parameters stay equal, and
they are those of one learner that has all the rollouts, up to the rounding of sums.

torchrun starts the ranks and says in the environment who they are (RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT). The
ranks of one machine (`deploy.learners`) find each other by a file instead (GROUP_FILE), so that they open no port to
other machines: neither torch's store nor its links ask who connects.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
import torch.distributed
from torch import Tensor

from common.comms.budgets import one_line
from common.comms.keys import rank_of
from common.errors import ReportedError

TIMEOUT: Final = timedelta(seconds=60)  # a rank that is silent for so long has died, and the group ends


class GroupError(ReportedError):
    """The environment does not say which rank this process is, or another rank is lost."""


@dataclass(frozen=True, slots=True)
class Group:
    """The ranks of one training; by default a learner alone."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this rank publishes, saves and logs for the group."""
        return self.rank == 0

    def rank_of(self, actor: str) -> int:
        """Return the rank that an actor belongs to."""
        return rank_of(actor, self.size)

    def owns(self, actor: str) -> bool:
        """Return whether an actor belongs to this rank."""
        return self.rank_of(actor) == self.rank

    def add(self, values: Tensor) -> None:
        """Replace ``values`` by their sum over the ranks, the same bits on each."""
        if self.size > 1:
            with self._together():
                torch.distributed.all_reduce(values)

    def gathered(
        self, array: npt.NDArray[Any], on_tick: Callable[[], None] | None = None
    ) -> list[npt.NDArray[Any]]:
        """Return every rank's array (n, ...), in the order of ranks; n may differ from rank to rank.

        Args:
            array: This rank's.
            on_tick: Called again and again until the other ranks have come.
        """
        if self.size == 1:
            return [array]
        own = torch.from_numpy(np.array(array))
        counts = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        self._all_gather(counts, torch.tensor([len(own)]), on_tick)
        longest = max(int(count) for count in counts)
        padded = own.new_zeros((longest, *own.shape[1:]))
        padded[: len(own)] = own
        rows = [torch.empty_like(padded) for _ in range(self.size)]
        self._all_gather(rows, padded)
        return [part[: int(count)].numpy() for part, count in zip(rows, counts, strict=True)]

    def gathered_bytes(self, items: Sequence[bytes]) -> list[list[bytes]]:
        """Return every rank's list of byte strings, in the order of ranks."""
        lengths = self.gathered(np.array([len(item) for item in items], np.int64))
        texts = self.gathered(np.frombuffer(b"".join(items), np.uint8))
        found = []
        for length, text in zip(lengths, texts, strict=True):
            ends = np.cumsum(length)
            found.append([text[end - n : end].tobytes() for n, end in zip(length, ends, strict=True)])
        return found

    def of_leader(self, value: bytes) -> bytes:
        """Return the leader's ``value``; those of other ranks are not looked at."""
        return self.gathered_bytes([value] if self.leads else [])[0][0]

    def leave(self) -> None:
        """Close the connections to the other ranks."""
        if self.size > 1:
            torch.distributed.destroy_process_group()

    def _all_gather(
        self, results: list[Tensor], own: Tensor, on_tick: Callable[[], None] | None = None
    ) -> None:
        with self._together():
            work = torch.distributed.all_gather(results, own, async_op=True)
            while on_tick is not None and not work.is_completed():
                on_tick()
            work.wait()

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Raise GroupError where another rank does not do its part."""
        try:
            yield
        except RuntimeError as error:
            reason = one_line(str(error), 200)
            raise GroupError(f"rank {self.rank} of {self.size} learners lost another one: {reason}") from None


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
    file = environment.get("GROUP_FILE", "")
    where = f"file://{file}" if file else "env://"
    try:
        torch.distributed.init_process_group(backend, where, rank=rank, world_size=size, timeout=TIMEOUT)
    except (ValueError, RuntimeError) as error:
        raise GroupError(f"rank {rank} of {size} found no group: {error}") from None
    return Group(rank, size)
