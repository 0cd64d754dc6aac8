"""Where an update computes its gradient steps: an engine.

``CpuEngine`` has the pass and the losses written out. ``services.learner.accelerator.DeviceEngine`` computes the same
on another device with autograd. An update is the same for both (``services.learner.ppo.update``).
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from common.policy.actor_critic import ActorCritic
from common.policy.losses import LossWeights, Slopes, Sums, add_losses
from common.policy.network_pass import NetworkPass, Precision
from services.learner.group import ALONE, Group
from services.learner.minibatches import Dataset

Array = npt.NDArray[np.float64]
MakeOptimizer = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


class Plan(NamedTuple):
    """What the steps of one update have in common."""

    weights: LossWeights
    learns_policy: bool = True  # and not the critic alone
    learns_noise: bool = True
    entropy_weight: float = 0.0
    gradient_norm: float = 1.0  # largest norm of the gradient
    group: Group = ALONE


class StepSums(NamedTuple):
    """What a gradient step came to; all are 0 for a step that was left out, since it was not finite.

    The first six are sums over this rank's frames of the minibatch, divided by its number of frames over all ranks.
    """

    kl: float  # KL(prox, new)
    policy: float  # the losses are without their weights
    value: float
    bound: float
    correction: float
    outside: float  # share of frames whose probability ratio is outside of the trust region
    norm: float  # of the whole gradient, before it was limited
    steps: float  # 1


OF_FRAMES: Final = len(StepSums._fields) - 2


class Engine(Protocol):
    """The network on the device that computes updates."""

    network: ActorCritic  # the network as everybody else reads it, in the CPU's memory
    optimizer: torch.optim.Optimizer
    dtype: torch.dtype  # of a dataset's observations

    def refresh(self) -> None:
        """Take the network's parameters as they are now; call it when somebody else has changed them."""
        ...

    def evaluate(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (n, A) and normalised values (n,), float32, for the critic's observations (n, D)."""
        ...

    def begin(self, data: Dataset, plan: Plan) -> Dataset:
        """Begin an update, and return its dataset where the steps take their minibatches from."""
        ...

    def step(self, batch: Dataset, count: int) -> Any:
        """Make one gradient step.

        Args:
            batch: This rank's frames of the minibatch; there may be none.
            count: Frames of the minibatch over all ranks.

        Returns:
            ``StepSums`` as one row for ``sums``. The step may not have ended yet.
        """
        ...

    def sums(self, rows: Sequence[Any]) -> Array:
        """Return the sum over rows of ``step`` (8,), once the steps have ended."""
        ...

    def end(self) -> None:
        """End an update: the network has the new parameters."""
        ...


class CpuEngine:
    """The update on the CPU.

    Args:
        network: Its parameters change in place.
        make_optimizer: Of parameters.
        rows: Largest minibatch.
        precision: Of the matrix products.
    """

    def __init__(
        self, network: ActorCritic, make_optimizer: MakeOptimizer, rows: int, precision: Precision
    ) -> None:
        self.network, self.optimizer = network, make_optimizer(network.parameters())
        self._pass = NetworkPass(network, rows, precision)
        self.dtype = self._pass.dtype
        self.refresh, self.evaluate = self._pass.refresh, self._pass.evaluate
        self._log_std = network.log_std.detach()
        shape = (rows, len(self._log_std))
        self._slopes = Slopes(*(np.zeros(size, np.float32) for size in (shape, shape[:1], shape[1:])))
        self._moved = np.zeros(shape[1])
        self._plan: Plan | None = None
        self._gradient = self._noise_gradient = torch.zeros(0)

    def begin(self, data: Dataset, plan: Plan) -> Dataset:
        """Begin an update; see ``Engine``."""
        self._plan = plan
        self._gradient, self._noise_gradient = self._pass.gradient_of(plan.learns_policy, plan.learns_noise)
        return data

    def step(self, batch: Dataset, count: int) -> Array:
        """Make one gradient step; see ``Engine``."""
        assert self._plan is not None
        plan, sums = self._plan, np.zeros(len(StepSums._fields))
        if len(batch):
            sums[1:OF_FRAMES] = self._backpropagate(batch, count, plan)
        else:
            self._gradient.zero_()
        plan.group.add(self._gradient.numpy())
        norm = limit_norm(self._gradient, plan.gradient_norm)
        if not np.isfinite(norm):
            return np.zeros_like(sums)
        self.optimizer.step()
        self._pass.refresh()
        if len(batch):
            sums[0] = float(kl_sum(batch, torch.from_numpy(self._moved), self._log_std))
        sums[:OF_FRAMES] /= count
        sums[OF_FRAMES:] = norm, 1.0
        return sums

    def _backpropagate(self, batch: Dataset, count: int, plan: Plan) -> Sums:
        """Write the gradient of a minibatch, and return its losses' sums."""
        mean, values = self._pass.forward(batch.obs)
        policy = (mean.numpy(), values.numpy(), self._log_std.numpy())
        found: Sums = add_losses(*policy, batch.frames(), plan.weights, count, *self._slopes, self._moved)
        rows = slice(len(batch))
        self._pass.backward(
            torch.from_numpy(self._slopes.mean[rows]) if plan.learns_policy else None,
            torch.from_numpy(self._slopes.value[rows]),
        )
        if plan.learns_noise:
            self._noise_gradient.copy_(torch.from_numpy(self._slopes.log_std))
            self._noise_gradient.sub_(plan.entropy_weight * len(batch) / count)
        return found

    def sums(self, rows: Sequence[Array]) -> Array:
        """Return the sum over rows of ``step`` (8,)."""
        total: Array = np.sum(rows, axis=0)
        return total

    def end(self) -> None:
        """End an update: nothing is left to do."""


def kl_sum(batch: Dataset, moved: Tensor, log_std: Tensor) -> Tensor:
    """Return the sum over a minibatch of KL(prox, new), on its device.

    Args:
        batch: Its frames.
        moved: Sum over the frames of the squared changes of the mean action (A,), float64.
        log_std: Of the new policy (A,).
    """
    old, new, rows = batch.log_std_prox.double(), log_std.double(), len(batch)
    spread = (rows * torch.exp(2.0 * old) + moved) / (2.0 * torch.exp(2.0 * new))
    return (rows * (new - old - 0.5) + spread).sum()


def limit_norm(gradient: Tensor, longest: float) -> float:
    """Shorten a gradient that is longer than ``longest``, and return its length before."""
    norm = float(torch.linalg.vector_norm(gradient))
    gradient.mul_(min(longest / (norm + 1e-6), 1.0))  # as torch's clip_grad_norm_ does
    return norm
