"""The actor-critic's forward and backward pass, written out: the learner's hot loop.

It computes what ``ActorCritic`` and autograd compute, at the same precision (a test compares them), with fewer passes
over memory. Each layer has one input array for its whole life: [previous layer's output, observation, 1]. ELU writes
its output into the next layer's input, so that nothing is concatenated; the column of ones makes the bias a column of
the weights. Weights are cast once a gradient step. The gradient with respect to observations is not computed.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple

import numpy.typing as npt
import torch
from torch import Tensor, nn

from common.policy.actor_critic import ActorCritic
from common.policy.elementwise import elu, elu_gradient, place

Precision = Literal["float32", "bfloat16"]
# Rows of products whose batch is not a full one: each new shape costs a compilation of its product
SIZE_STEP: Final = 64
LINE: Final = 64  # [bytes] of a cache line
DTYPES: Final[dict[Precision, torch.dtype]] = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def native_precision() -> Precision:
    """Return bfloat16 where the CPU multiplies it natively, and float32 elsewhere."""
    can = torch.cpu.get_capabilities()
    return "bfloat16" if can.get("avx512_bf16") or can.get("amx_bf16") else "float32"


def _bits(tensor: Tensor) -> npt.NDArray[Any]:
    """Return a tensor's memory as the kernels read it: float32, or the bits of bfloat16 (uint16)."""
    return (tensor.view(torch.uint16) if tensor.dtype is torch.bfloat16 else tensor).numpy()


class _Rows(NamedTuple):
    """Views of a layer's first rows, as its products and kernels take them."""

    inputs: Tensor  # (n, K)
    outputs: Tensor  # (n, N)
    slope: Tensor  # (n, N)
    slope_transposed: Tensor  # (N, n)
    output_bits: npt.NDArray[Any]
    slope_bits: npt.NDArray[Any]


class _Part(NamedTuple):
    """A linear layer's weight and bias, where the products have them, and where they leave the gradients."""

    parameters: tuple[Tensor, Tensor]
    places: tuple[Tensor, Tensor]
    slopes: tuple[Tensor, Tensor]


class _Layer:
    """Linear layers of the same inputs, with arrays of their own: inputs [hidden, observation, 1], outputs, gradients.

    Rows of inputs and weights begin at a cache line. What fills them up is zero, as are the weights of a linear layer
    that does not take the observation.

    Args:
        linears: Their parameters.
        observed: How many numbers of the observation the first of them takes after the hidden ones.
        rows: Largest batch.
        dtype: Of its products.
    """

    def __init__(self, linears: Sequence[nn.Linear], observed: int, rows: int, dtype: torch.dtype) -> None:
        self.observed = observed
        bias = linears[0].in_features
        self.hidden = bias - observed
        step = LINE // dtype.itemsize
        width, size = -(-(bias + 1) // step) * step, sum(linear.out_features for linear in linears)
        self._weights, self._gradient = (torch.zeros((size, width), dtype=dtype) for _ in range(2))
        self._inputs = torch.zeros((rows, width), dtype=dtype)
        self._inputs[:, bias] = 1.0
        self._outputs, self._slope = (torch.zeros((rows, size), dtype=dtype) for _ in range(2))
        self.input_bits = _bits(self._inputs)
        self._weights_transposed, self._hidden_weights = self._weights.t(), self._weights[:, : self.hidden]
        self._rows: dict[int, _Rows] = {}
        sizes = [linear.out_features for linear in linears]
        places, slopes = (torch.split(of, sizes) for of in (self._weights, self._gradient))
        self.parts = [
            _Part((linear.weight, linear.bias), *((of[:, : linear.in_features], of[:, bias]) for of in both))
            for linear, *both in zip(linears, places, slopes, strict=True)
        ]

    def first(self, count: int) -> _Rows:
        """Return the first ``count`` rows."""
        if count not in self._rows:
            inputs, outputs, slope = (of[:count] for of in (self._inputs, self._outputs, self._slope))
            self._rows[count] = _Rows(inputs, outputs, slope, slope.t(), _bits(outputs), _bits(slope))
        return self._rows[count]

    def take(self, bits: npt.NDArray[Any]) -> None:
        """Take the observations (n, ...) of a batch."""
        if self.observed:
            place(bits, self.observed, self.input_bits, self.hidden)

    def forward(self, count: int) -> _Rows:
        """Compute the outputs of the first ``count`` inputs."""
        rows = self.first(count)
        torch.mm(rows.inputs, self._weights_transposed, out=rows.outputs)
        return rows

    def last_outputs(self, count: int, size: int) -> Tensor:
        """Return the last ``size`` outputs alone (count, size)."""
        return torch.mm(self.first(count).inputs, self._weights[-size:].t())

    def backward(self, count: int) -> None:
        """Compute the parameters' gradients, given the outputs' slope."""
        rows = self.first(count)
        torch.mm(rows.slope_transposed, rows.inputs, out=self._gradient)

    def backward_hidden(self, count: int, out: Tensor) -> None:
        """Write the slope with respect to the hidden inputs (count, hidden)."""
        torch.mm(self.first(count).slope, self._hidden_weights, out=out)


class NetworkPass:
    """Forward and backward pass of one network over batches of up to ``rows`` observations.

    Args:
        network: ``refresh`` reads its parameters; ``backward`` writes the gradient that ``gradient_of`` returns.
        rows: Largest batch.
        precision: Of the products, and of the numbers between layers.
    """

    def __init__(self, network: ActorCritic, rows: int, precision: Precision) -> None:
        self.network = network
        self.rows = rows
        self.dtype = DTYPES[precision]
        self._actions = network.mean.out_features
        head = network.critic_head
        critic = [part for part in head or [] if isinstance(part, nn.Linear)] + [network.value]
        trunk = [
            _Layer([linear], network.obs_size, rows, self.dtype) for linear in _linears(network.trunk.layers)
        ]
        # The critic's first layer and the mean actions take the trunk's outputs, and are one product
        beyond_trunk = critic[0].in_features - network.trunk.out_features
        self._heads = _Layer([critic[0], network.mean], beyond_trunk, rows, self.dtype)
        self._trunk = [*trunk, self._heads]
        self._critic = [self._heads, *(_Layer([linear], 0, rows, self.dtype) for linear in critic[1:])]
        self._layers = [*trunk, *self._critic]
        parts = {id(part.parameters[0]): part for layer in self._layers for part in layer.parts}
        policy, critics = (
            [parts[id(linear.weight)] for linear in linears]
            for linears in ([*_linears(network.trunk.layers), network.mean], critic)
        )
        self._parameters = [parameter for part in policy + critics for parameter in part.parameters]
        self._places = [place for part in policy + critics for place in part.places]
        self._slopes = [slope for part in policy + critics for slope in part.slopes]
        self._of_policy = 2 * len(policy)
        # One array holds all gradients: the noise's, the policy's, the critic's
        self._learning = [network.log_std, *self._parameters]
        sizes = [parameter.numel() for parameter in self._learning]
        self._gradient = torch.zeros(sum(sizes))
        split = torch.split(self._gradient, sizes)
        self._gradients = [part.view_as(of) for part, of in zip(split, self._learning, strict=True)]
        self._count = 0  # observations of the last forward pass
        # Rows of its products: the observations, and rows of earlier batches that nobody reads
        self._size = 0
        self.refresh()

    def gradient_of(self, learns_policy: bool, learns_noise: bool) -> tuple[Tensor, Tensor]:
        """Return the gradient of what learns (P,), and the noise's part of it: (A,), or (0,) if that does not learn.

        The parameters' ``grad`` are views of it from now on, and None where they do not learn.

        Args:
            learns_policy: Whether the policy learns, and not the critic alone.
            learns_noise: Whether the log standard deviation learns too.
        """
        first = 0 if learns_noise else 1 if learns_policy else 1 + self._of_policy
        for index, (parameter, gradient) in enumerate(zip(self._learning, self._gradients, strict=True)):
            parameter.grad = gradient if index >= first else None
        start = sum(gradient.numel() for gradient in self._gradients[:first])
        return self._gradient[start:], self._gradients[0] if learns_noise else torch.zeros(0)

    @torch.no_grad()
    def refresh(self) -> None:
        """Take the network's parameters as they are now; call it whenever they have changed."""
        torch._foreach_copy_(self._places, self._parameters)

    @torch.no_grad()
    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (n, A) and normalised values (n,), float32, as ``ActorCritic.forward`` does.

        Args:
            obs: The critic's observations, normalised (n, D), contiguous.
        """
        size = self._run_trunk(obs := obs.to(self.dtype))
        self._heads.take(_bits(obs))
        self._run(self._critic, size)
        last = self._critic[-1].forward(size)
        mean = self._heads.first(size).outputs[: len(obs), -self._actions :]
        return mean.to(torch.float32, copy=True), last.outputs[: len(obs), 0].to(torch.float32, copy=True)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Return mean actions (n, A), float32, as ``ActorCritic.act`` does.

        Args:
            obs: The policy's observations, normalised (n, obs_size), contiguous.
        """
        size = self._run_trunk(obs.to(self.dtype))
        return self._heads.last_outputs(size, self._actions)[: len(obs)].to(torch.float32, copy=True)

    def _run_trunk(self, obs: Tensor) -> int:
        """Run the trunk, up to the heads' hidden inputs, and return how many rows its products have."""
        self._count = len(obs)
        self._size = min(-(-self._count // SIZE_STEP) * SIZE_STEP, self.rows)
        bits = _bits(obs)
        for layer in self._trunk[:-1]:
            layer.take(bits)
        self._run(self._trunk, self._size)
        return self._size

    @staticmethod
    def _run(layers: list[_Layer], size: int) -> None:
        """Run layers with ELU between them, up to the inputs of the last."""
        for layer, following in pairwise(layers):
            rows = layer.forward(size)
            elu(rows.output_bits, following.input_bits, following.hidden)

    def evaluate(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return what ``forward`` does, for any number of observations."""
        parts = [self.forward(part) for part in torch.split(obs, self.rows)]
        means, values = zip(*parts, strict=True)
        return torch.cat(means), torch.cat(values)

    @torch.no_grad()
    def backward(self, mean: Tensor | None, value: Tensor | None) -> None:
        """Write the gradient of the parameters for the last ``forward``; ``log_std`` is not one of its.

        Args:
            mean: Slope of the loss with respect to the mean actions (n, A); None: only the critic's own layers learn.
            value: Slope with respect to the values (n,); None: 0.
        """
        count, size = self._count, self._size
        values = self._critic[-1].first(size).slope[:, 0]
        values[:count] = 0.0 if value is None else value
        values[count:] = 0.0
        means = self._heads.first(size).slope[:, -self._actions :]
        means[:count] = 0.0 if mean is None else mean
        means[count:] = 0.0
        layers = self._critic if mean is None else self._layers
        for before, layer in reversed(list(pairwise(layers))):
            layer.backward(size)
            rows = before.first(size)
            layer.backward_hidden(size, rows.slope[:, : layer.hidden])
            elu_gradient(layer.input_bits, rows.slope_bits, layer.hidden)
        layers[0].backward(size)
        first = self._of_policy if mean is None else 0
        torch._foreach_copy_(self._gradients[1 + first :], self._slopes[first:])


def _linears(layers: nn.ModuleList) -> list[nn.Linear]:
    """Return linear layers as such."""
    found = [layer for layer in layers if isinstance(layer, nn.Linear)]
    if len(found) < len(layers):
        raise TypeError(f"{', '.join(type(layer).__name__ for layer in layers)} as layers; allowed: Linear")
    return found
