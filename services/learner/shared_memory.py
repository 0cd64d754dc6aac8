"""Links between the ranks of one machine: memory that they share, and a byte over a Unix socket when it is written.

A rank writes into its mailbox, sends one byte to each other rank, and waits for theirs. It has two mailboxes and uses
them in turns: who has every rank's byte knows that all of them have read the mailboxes of the turn before. The kernel
orders memory around a system call, so no rank reads what is half written. A rank that ends closes its sockets, and the
others notice at once.

Why not torch's gloo: it has threads of its own for its messages, and where every core computes they wait for one
(ADR-0062).
"""

import mmap
import os
import select
import socket
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

MAILBOX: Final = 2**20  # bytes of a mailbox; what is longer goes in pieces
HEADER: Final = 64  # its first bytes: how many bytes are still to come; the rest of them aligns what follows
ROOM: Final = MAILBOX - HEADER
# Bytes of the other ranks' parts that each rank adds up itself. Of more, each rank adds up a share, and the shares are
# exchanged: a turn more, and less to read.
READ_BY_ALL: Final = 2**20
RETRY_S: Final = 0.01  # between two looks for a rank that starts

Bytes = npt.NDArray[np.uint8]


class SharedMemoryLinks:
    """Links of one rank to all the others.

    Args:
        rank: This one.
        size: Number of ranks.
        file: In a folder of this user alone: the ranks meet at sockets of this name, which they then remove.
        timeout_s: Longest wait for another rank.

    Raises:
        OSError: The others do not come.
    """

    def __init__(self, rank: int, size: int, file: Path, timeout_s: float) -> None:
        self._rank, self._size, self._timeout_s = rank, size, timeout_s
        self._sockets = _meet(rank, size, file, timeout_s)
        memory = _share(rank, self._sockets, 2 * size * MAILBOX)
        mailboxes = np.frombuffer(memory, np.uint8).reshape(2, size, MAILBOX)
        self._left = mailboxes[..., :8].view(np.int64)[..., 0]  # (2, size) bytes from this piece on
        self._boxes = mailboxes[..., HEADER:]  # (2, size, ROOM)
        self._turns = 0

    def exchanged(self, own: bytes, on_tick: Callable[[], None] | None = None) -> list[bytes]:
        """Return every rank's bytes, in the order of ranks; lengths may differ.

        Args:
            own: This rank's.
            on_tick: Called again and again until the other ranks have come.
        """
        parts = [bytearray() for _ in range(self._size)]
        start, is_more = 0, True
        while is_more:
            lengths = self._left[self._turns % 2]
            lengths[self._rank] = max(len(own) - start, 0)
            boxes = self._turn(np.frombuffer(own[start : start + ROOM], np.uint8), on_tick)
            for part, box, length in zip(parts, boxes, lengths.tolist(), strict=True):
                part.extend(box[: min(length, ROOM)].tobytes())
            start, is_more = start + ROOM, bool(lengths.max() > ROOM)
        return [bytes(part) for part in parts]

    def add(self, values: npt.NDArray[Any]) -> None:
        """Replace ``values`` (n,), contiguous, by their sum over the ranks: the same bits on each."""
        step = ROOM // values.itemsize
        for start in range(0, len(values), step):
            self._add(values[start : start + step])

    def add_tensor(self, values: Tensor) -> None:
        """Do the same with a tensor (n,), contiguous, on any device: by way of the CPU's memory."""
        own = values.cpu().numpy()
        self.add(own)
        values.copy_(torch.from_numpy(own))

    def close(self) -> None:
        """Close the sockets; the memory is freed when the last rank has left it."""
        for link in self._sockets.values():
            link.close()

    def _add(self, values: npt.NDArray[Any]) -> None:
        """Do what ``add`` does, for values that fit into a mailbox."""
        count, parts = len(values), self._turn(values.view(np.uint8)).view(values.dtype)
        if (self._size - 1) * values.nbytes <= READ_BY_ALL:
            _sum(parts[:, :count], values)
            return
        ends = [count * (rank + 1) // self._size for rank in range(self._size)]
        shares = [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]
        own = values[shares[self._rank]]
        _sum(parts[:, shares[self._rank]], own)
        totals = self._turn(own.view(np.uint8)).view(values.dtype)
        for total, share in zip(totals, shares, strict=True):
            values[share] = total[: share.stop - share.start]

    def _turn(self, own: Bytes, on_tick: Callable[[], None] | None = None) -> Bytes:
        """Write into this rank's mailbox, and return those of all (size, ROOM) when each has written its own."""
        boxes: Bytes = self._boxes[self._turns % 2]
        self._turns += 1
        boxes[self._rank, : len(own)] = own
        for link in self._sockets.values():
            link.sendall(b".")
        deadline = time.monotonic() + self._timeout_s
        for other, link in self._sockets.items():
            while on_tick is not None and not _has_news(link):
                if time.monotonic() > deadline:
                    raise TimeoutError(f"rank {other} has been silent for {self._timeout_s:g} s")
                on_tick()
            if not link.recv(1):
                raise ConnectionError(f"rank {other} has ended")
        return boxes


def _sum(parts: npt.NDArray[Any], out: npt.NDArray[Any]) -> None:
    """Write the sum of ``parts`` (ranks, n) in their order, which decides its last bits, into ``out`` (n,)."""
    np.add(parts[0], parts[1], out=out)
    for part in parts[2:]:
        out += part


def _has_news(link: socket.socket) -> bool:
    """Return whether a byte is there, or the other side has ended."""
    return bool(select.select([link], [], [], 0.0)[0])


def _meet(rank: int, size: int, file: Path, timeout_s: float) -> dict[int, socket.socket]:
    """Return a socket to each other rank: this one calls those before it, and is called by those after it."""
    door = _door(file, rank)
    links = {}
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(door))
        listener.settimeout(timeout_s)
        listener.listen(size)
        for other in range(rank):
            links[other] = _call(_door(file, other), timeout_s)
            links[other].sendall(rank.to_bytes(4, "big"))
        for _ in range(rank + 1, size):
            link, _ = listener.accept()
            link.settimeout(timeout_s)
            links[int.from_bytes(link.recv(4), "big")] = link
    door.unlink()
    return dict(sorted(links.items()))


def _door(file: Path, rank: int) -> Path:
    """Return the path at which a rank is called."""
    return file.with_name(f"{file.name}-{rank}")


def _call(door: Path, timeout_s: float) -> socket.socket:
    """Return a socket to the rank at ``door``, which may be starting still."""
    deadline = time.monotonic() + timeout_s
    while True:
        link = socket.socket(socket.AF_UNIX)
        link.settimeout(timeout_s)
        try:
            link.connect(str(door))
        except (FileNotFoundError, ConnectionRefusedError):  # no socket there yet, or it does not listen yet
            link.close()
            if time.monotonic() > deadline:
                raise TimeoutError(f"no rank at {door} after {timeout_s:.0f} s") from None
            time.sleep(RETRY_S)
            continue
        return link


def _share(rank: int, links: dict[int, socket.socket], size: int) -> mmap.mmap:
    """Return ``size`` bytes of memory that all ranks have: a file without a name, which the first one makes."""
    if rank == 0:
        # In memory where the system can; a file on a disk would be written back again and again
        file = os.memfd_create("topspin") if hasattr(os, "memfd_create") else _nameless_file()
        os.truncate(file, size)
        for link in links.values():
            socket.send_fds(link, [b"."], [file])
    else:
        _, (file,), *_ = socket.recv_fds(links[0], 1, 1)
    try:
        return mmap.mmap(file, size)
    finally:
        os.close(file)


def _nameless_file() -> int:
    """Return the descriptor of a file that no folder has."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
