"""Links between the ranks of several machines: torch.distributed, as torchrun has set it up.

Gloo sums what is in the CPU's memory, and NCCL what is on a GPU.
"""

from collections.abc import Callable
from datetime import timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.distributed
from torch import Tensor


class TorchLinks:
    """Links of one rank to all the others.

    Args:
        rank: This one.
        size: Number of ranks.
        timeout_s: Longest wait for another rank.

    Raises:
        ValueError, RuntimeError: The environment is incomplete, or the others do not come.
    """

    def __init__(self, rank: int, size: int, timeout_s: float) -> None:
        self._size = size
        has_nccl = torch.cuda.is_available() and torch.distributed.is_nccl_available()
        backends = "cpu:gloo,cuda:nccl" if has_nccl else "gloo"
        torch.distributed.init_process_group(
            backends, "env://", rank=rank, world_size=size, timeout=timedelta(seconds=timeout_s)
        )

    def exchanged(self, own: bytes, on_tick: Callable[[], None] | None = None) -> list[bytes]:
        """Return every rank's bytes, in the order of ranks; lengths may differ.

        Args:
            own: This rank's.
            on_tick: Called again and again until the other ranks have come.
        """
        lengths = [int(length) for length in self._gathered(torch.tensor([len(own)]), on_tick)]
        padded = torch.zeros(max(lengths), dtype=torch.uint8)
        padded[: len(own)] = torch.from_numpy(np.frombuffer(own, np.uint8).copy())
        return [
            part[:length].numpy().tobytes()
            for part, length in zip(self._gathered(padded), lengths, strict=True)
        ]

    def add(self, values: npt.NDArray[Any]) -> None:
        """Replace ``values`` (n,), contiguous, by their sum over the ranks: the same bits on each."""
        torch.distributed.all_reduce(torch.from_numpy(values))

    def add_tensor(self, values: Tensor) -> None:
        """Do the same with a tensor (n,), contiguous, on any device."""
        torch.distributed.all_reduce(values)

    def close(self) -> None:
        """Leave torch's process group."""
        torch.distributed.destroy_process_group()

    def _gathered(self, own: Tensor, on_tick: Callable[[], None] | None = None) -> list[Tensor]:
        """Return every rank's tensor, all of one shape."""
        results = [torch.empty_like(own) for _ in range(self._size)]
        work = torch.distributed.all_gather(results, own, async_op=True)
        while on_tick is not None and not work.is_completed():
            on_tick()
        work.wait()
        return results
