"""An update's data, a rank's share of it, and its division into minibatches."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Final, NamedTuple, Self

import torch
from torch import Tensor

from common.policy.losses import Frames
from services.learner.group import ALONE, Group


@dataclass(frozen=True, slots=True)
class Dataset:
    """One epoch's data, flattened, with everything that doesn't change during the update."""

    obs: Tensor  # (N, D) normalised
    actions: Tensor  # (N, A)
    log_mu: Tensor  # (N,) as recorded by the actor
    log_prox: Tensor  # (N,)
    mean_prox: Tensor  # (N, A)
    advantages: Tensor  # (N,) normalised
    value_targets: Tensor  # (N,) normalised
    corrections: Tensor  # (N, A) change of the mean action to aim at (or the teacher's); rows of zeros: none
    log_std_prox: Tensor  # (A,)

    def __len__(self) -> int:
        return len(self.obs)

    def taken(self, rows: Tensor) -> Self:
        """Return the frames of some rows, as copies."""
        return self._of(lambda column: torch.index_select(column, 0, rows))

    def between(self, start: int, end: int) -> Self:
        """Return the frames of a range of rows, as views."""
        return self._of(lambda column: column[start:end])

    def _of(self, part: Callable[[Tensor], Tensor]) -> Self:
        return replace(self, **{name: part(getattr(self, name)) for name in COLUMNS})

    def pinned(self) -> Self:
        """Return the same frames in page-locked memory, which a device reads by itself."""
        return replace(self, **{field.name: getattr(self, field.name).pin_memory() for field in fields(self)})

    def on(self, device: torch.device) -> Self:
        """Return the same frames in the memory of a device."""
        parts = {
            field.name: getattr(self, field.name).to(device, non_blocking=True) for field in fields(self)
        }
        return replace(self, **parts)

    def frames(self) -> Frames:
        """Return what the losses need of them."""
        return Frames(*(getattr(self, name).numpy() for name in Frames._fields))


COLUMNS: Final = tuple(field.name for field in fields(Dataset) if field.name != "log_std_prox")


class Share(NamedTuple):
    """Which frames of the group's dataset a rank has, and what it must know of the others'."""

    group: Group
    first: int  # index of its first frame
    frames: int  # of the whole dataset
    weight: float  # mean of pi_prox/mu before clipping, of the whole dataset
    has_corrections: bool  # whether any frame has one


def whole(data: Dataset) -> Share:
    """Return the share of a learner alone: all of its dataset."""
    weight = weight_sum(data.log_prox, data.log_mu) / len(data)
    return Share(ALONE, 0, len(data), weight, are_any(data.corrections))


def weight_sum(log_prox: Tensor, log_mu: Tensor) -> float:
    """Return the sum of pi_prox/mu over the frames, before clipping."""
    return float((log_prox - log_mu).exp().sum())


def are_any(corrections: Tensor) -> bool:
    """Return whether any frame has a correction."""
    return bool((corrections != 0.0).any())


def minibatches(
    data: Dataset, size: int, generator: torch.Generator, share: Share
) -> Iterator[tuple[Dataset, int]]:
    """Yield one pass over the group's dataset: its frames in random order, ``size`` at a time.

    Args:
        data: This rank's frames.
        size: Frames of a minibatch, over all ranks.
        generator: The CPU's, in the same state on every rank.
        share: Which frames of the whole dataset ``data`` are.

    Yields:
        This rank's frames of a minibatch, and how many the minibatch has over all ranks.
    """
    order = torch.randperm(share.frames, generator=generator)
    is_own = (order >= share.first) & (order < share.first + len(data))
    shuffled = data.taken((order[is_own] - share.first).to(data.obs.device))
    at = 0
    for mine in torch.split(is_own, size):
        count = int(mine.sum())
        # a small remainder would weigh as much as a full batch
        if len(mine) >= min(size, share.frames) // 2:
            yield shuffled.between(at, at + count), len(mine)
        at += count
