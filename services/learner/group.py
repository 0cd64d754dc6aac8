"""A group of learners that train one policy together: data-parallel.

Every rank has the same network, optimiser and random state, and the rollouts of its own actors. The dataset of an epoch
is the rollouts of all ranks, in the order of ranks. A minibatch is drawn from the whole dataset. Each rank computes the
part of its gradient that belongs to its own frames, and the parts are summed. So the ranks' parameters stay equal, and
they are those of one learner that has all the rollouts, up to the rounding of sums.

torchrun starts the ranks and says in the environment who they are (RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT). The
ranks of one machine (`deploy.learners`) have a file instead (GROUP_FILE): they share memory, and open no port.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from common.comms.budgets import one_line
from common.comms.keys import rank_of
from common.errors import ReportedError
from services.learner.shared_memory import SharedMemoryLinks
from services.learner.torch_links import TorchLinks

TIMEOUT_S: Final = 60.0  # a rank that is silent for so long has died, and the group ends

Array = npt.NDArray[Any]


class GroupError(ReportedError):
    """The environment does not say which rank this process is, or another rank is lost."""


class Links(Protocol):
    """A rank's links to the others. All ranks make the same calls in the same order.

    Every method raises RuntimeError or OSError where another rank does not do its part. A sum of tensors on a GPU is
    only begun: there NCCL ends the process instead.
    """

    def exchanged(self, own: bytes, on_tick: Callable[[], None] | None = None) -> list[bytes]:
        """Return every rank's bytes, in the order of ranks; ``on_tick`` is called until the others have come."""
        ...

    def add(self, values: Array) -> None:
        """Replace ``values`` (n,), contiguous, by their sum over the ranks: the same bits on each."""
        ...

    def add_tensor(self, values: Any) -> None:
        """Do the same with a tensor (n,), contiguous, on any device."""
        ...

    def close(self) -> None:
        """Close them."""
        ...


@dataclass(frozen=True, slots=True)
class Group:
    """The ranks of one training; by default a learner alone."""

    rank: int = 0
    size: int = 1
    links: Links | None = field(default=None, compare=False)  # None: there is no other rank

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

    def add(self, values: Array) -> None:
        """Replace ``values`` (n,), contiguous, by their sum over the ranks: the same bits on each."""
        if self.links is not None:
            with self._together():
                self.links.add(values)

    def add_tensor(self, values: Any) -> None:
        """Replace a tensor (n,), contiguous, by its sum over the ranks, on the device that it is on."""
        if self.links is not None:
            with self._together():
                self.links.add_tensor(values)

    def gathered(self, *arrays: Array, on_tick: Callable[[], None] | None = None) -> list[list[Array]]:
        """Return every rank's arrays, in the order of ranks, by one message; of other ranks they are read-only.

        Args:
            arrays: This rank's (n, ...); n may differ from rank to rank, all else is the same.
            on_tick: Called again and again until the other ranks have come.
        """
        if self.links is None:
            return [list(arrays)]
        ranks = self.gathered_bytes([array.tobytes() for array in arrays], on_tick)
        return [
            [
                np.frombuffer(part, array.dtype).reshape(-1, *array.shape[1:])
                for part, array in zip(parts, arrays, strict=True)
            ]
            for parts in ranks
        ]

    def gathered_bytes(
        self, items: Sequence[bytes], on_tick: Callable[[], None] | None = None
    ) -> list[list[bytes]]:
        """Return every rank's list of byte strings, in the order of ranks; their numbers may differ."""
        if self.links is None:
            return [list(items)]
        lengths = np.array([len(items), *map(len, items)], np.int64)
        with self._together():
            ranks = self.links.exchanged(b"".join((lengths.tobytes(), *items)), on_tick)
        return [_apart(text) for text in ranks]

    def of_leader(self, value: bytes) -> bytes:
        """Return the leader's ``value``; those of other ranks are not looked at."""
        return self.gathered_bytes([value] if self.leads else [])[0][0]

    def leave(self) -> None:
        """Close the connections to the other ranks."""
        if self.links is not None:
            self.links.close()

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Raise GroupError where another rank does not do its part."""
        try:
            yield
        except (RuntimeError, OSError) as error:
            reason = one_line(str(error), 200)
            raise GroupError(f"rank {self.rank} of {self.size} learners lost another one: {reason}") from None


def _apart(text: bytes) -> list[bytes]:
    """Return the byte strings that ``Group.gathered_bytes`` has joined: their number, their lengths, themselves."""
    count = int(np.frombuffer(text, np.int64, 1)[0])
    lengths = np.frombuffer(text, np.int64, 1 + count)[1:]
    ends = 8 * (1 + count) + np.cumsum(lengths)
    return [text[end - length : end] for end, length in zip(ends, lengths, strict=True)]


ALONE: Final = Group()


def join(environment: Mapping[str, str] = os.environ) -> Group:
    """Return the group that torchrun or `deploy.learners` has put this process into; ``ALONE`` without them.

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
        return Group(rank, size, _links(rank, size, environment.get("GROUP_FILE", "")))
    except (ValueError, RuntimeError, OSError) as error:
        raise GroupError(f"rank {rank} of {size} found no group: {error}") from None


def _links(rank: int, size: int, file: str) -> Links:
    """Return the links to the other ranks: over shared memory if they have a file, else those of torch."""
    return SharedMemoryLinks(rank, size, Path(file), TIMEOUT_S) if file else TorchLinks(rank, size, TIMEOUT_S)
