"""The update on an accelerator: the same losses by autograd, and no step waits for its numbers."""

import copy
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from common.policy.actor_critic import ActorCritic, log_prob
from common.policy.losses import LossWeights
from common.policy.network_pass import DTYPES, Precision
from services.learner.engine import MakeOptimizer, Plan, StepSums, kl_sum
from services.learner.minibatches import Dataset

Array = npt.NDArray[np.float64]

SIZE: Final = len(StepSums._fields)
HIGHEST: Final = 80.0  # log of a probability ratio: exp of 89 is no float32


class DeviceEngine:
    """The update on another device. It has a copy of the network there, and gives the parameters back at the end.

    Args:
        network: The CPU's. Its parameters change when an update ends.
        make_optimizer: Of parameters; a fused one, which leaves out a step by ``found_inf``.
        device: Where it computes.
        precision: Of the matrix products.
    """

    def __init__(
        self,
        network: ActorCritic,
        make_optimizer: MakeOptimizer,
        device: torch.device,
        precision: Precision,
    ) -> None:
        self.network, self.dtype = network, DTYPES[precision]
        self._device = device
        self._copy = copy.deepcopy(network).to(device)
        self.optimizer = make_optimizer(self._copy.parameters())
        critic: list[nn.Parameter] = [*(self._copy.critic_head or nn.Module()).parameters()]
        critic += self._copy.value.parameters()
        policy = [p for p in self._copy.policy_parameters() if p is not self._copy.log_std]
        self._all = [self._copy.log_std, *policy, *critic]
        self._critic = critic
        self._learning = self._all
        self._gradient = torch.zeros(0)
        self._gradients: list[Tensor] = []
        self._plan: Plan | None = None

    @torch.no_grad()
    def refresh(self) -> None:
        """Take the network's parameters as they are now."""
        torch._foreach_copy_(list(self._copy.parameters()), list(self.network.parameters()))

    @torch.no_grad()
    def evaluate(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (n, A) and normalised values (n,), float32, in the CPU's memory."""
        mean, value = self._forward(obs.to(self._device, self.dtype, non_blocking=True))
        return mean.cpu(), value.cpu()

    def _forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self.dtype is torch.bfloat16):
            mean, value = self._copy(obs)
        return mean.float(), value.float()

    def begin(self, data: Dataset, plan: Plan) -> Dataset:
        """Begin an update, and return its dataset on the device."""
        self._plan = plan
        first = 0 if plan.learns_noise else 1 if plan.learns_policy else len(self._all) - len(self._critic)
        self._learning = self._all[first:]
        sizes = [parameter.numel() for parameter in self._learning]
        self._gradient = torch.zeros(sum(sizes), device=self._device)
        parts = torch.split(self._gradient, sizes)
        self._gradients = [part.view_as(of) for part, of in zip(parts, self._learning, strict=True)]
        for parameter in self._all:
            parameter.grad = None
        for parameter, gradient in zip(self._learning, self._gradients, strict=True):
            parameter.grad = gradient
        is_pinned = self._device.type == "cuda"  # only then a copy runs beside the CPU
        return (data.pinned() if is_pinned else data).on(self._device)

    def step(self, batch: Dataset, count: int) -> Tensor:
        """Make one gradient step; the sums are on the device, and may not be known yet."""
        assert self._plan is not None
        plan, sums = self._plan, torch.zeros(SIZE, dtype=torch.float64, device=self._device)
        if len(batch):
            loss, found, moved = losses(*self._forward(batch.obs), self._copy.log_std, batch, plan, count)
            torch._foreach_copy_(self._gradients, torch.autograd.grad(loss, self._learning))
            sums[1 : len(found) + 1] = found
        else:
            self._gradient.zero_()
        plan.group.add_tensor(self._gradient)
        norm = torch.linalg.vector_norm(self._gradient)
        is_finite = norm.isfinite()
        self._gradient.mul_((plan.gradient_norm / (norm + 1e-6)).clamp(max=1.0))
        self.optimizer.found_inf = (~is_finite).float()  # type: ignore[attr-defined]  # read by fused optimisers
        self.optimizer.step()
        if len(batch):
            sums[0] = kl_sum(batch, moved, self._copy.log_std.detach())
        sums /= count
        sums[-2] = norm
        sums[-1:] = 1.0  # not sums[-1]: a number that is copied there would be waited for
        return torch.where(is_finite, sums, 0.0)

    def sums(self, rows: Sequence[Tensor]) -> Array:
        """Return the sum over rows of ``step`` (8,): here the CPU waits for the steps."""
        found: Array = torch.stack(list(rows)).sum(0).cpu().numpy()
        return found

    @torch.no_grad()
    def end(self) -> None:
        """End an update: the network has the new parameters."""
        torch._foreach_copy_(list(self.network.parameters()), list(self._copy.parameters()))


def losses(
    mean: Tensor, values: Tensor, log_std: Tensor, batch: Dataset, plan: Plan, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a minibatch's loss, its parts' sums, and the sum of the squared changes of the mean action (A,).

    The formulas are those of ``common.policy.losses``.

    Args:
        mean: Mean actions (n, A).
        values: Normalised (n,).
        log_std: (A,).
        batch: The n frames.
        plan: What counts.
        count: Frames of the minibatch over all ranks.
    """
    weights: LossWeights = plan.weights
    # A ratio that overflows would make the gradient NaN where it is clipped
    ratio = torch.exp((log_prob(batch.actions, mean, log_std) - batch.log_prox).clamp(max=HIGHEST))
    weight = torch.exp(batch.log_prox - batch.log_mu).clamp(max=weights.most_weight)
    clipped = ratio.clamp(1.0 - weights.clip, 1.0 + weights.clip)
    gained = torch.minimum(ratio * batch.advantages, clipped * batch.advantages)
    # A product with 0 would not do: a ratio may be infinite where nobody reads it
    policy = -(weight * gained).sum() if weights.has_surrogate else torch.zeros((), device=mean.device)
    value = 0.5 * (values - batch.value_targets).square().sum()
    bound = (mean.abs() - 1.0).clamp(min=0.0).square().sum()
    acted = batch.actions if weights.from_played else batch.mean_prox
    is_corrected = (batch.corrections != 0.0).any(-1, keepdim=True) & (weights.correction > 0.0)
    correction = 0.5 * ((mean - acted - batch.corrections).square() * is_corrected).sum()
    outside = ((ratio - 1.0).abs() > weights.clip).sum()
    loss = policy + weights.value * value + weights.bound * bound + weights.correction * correction
    loss = loss / count - plan.entropy_weight * log_std.sum() * (len(batch.actions) / count)
    found = torch.stack([of.detach().double() for of in (policy, value, bound, correction, outside)])
    return loss, found, (mean.detach() - batch.mean_prox).double().square().sum(0)
