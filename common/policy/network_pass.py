"""The actor-critic's forward and backward pass, written out: the learner's hot loop.

It computes what ``ActorCritic`` and autograd compute, at the same precision (a test compares them), with fewer passes
over memory. Each layer has one input array for its whole life: [previous layer's output, observation, 1]. ELU writes
its output into the next layer's input, so that nothing is concatenated; the column of ones makes the bias a column of
the weights. Weights are cast once a gradient step. The gradient with respect to observations is not computed.
"""

from itertools import pairwise
from typing import Any, Final, Literal

import numpy.typing as npt
import torch
from torch import Tensor, nn

from common.policy.actor_critic import ActorCritic
from common.policy.elementwise import elu, elu_gradient, place

Precision = Literal["float32", "bfloat16"]
SIZE_STEP: Final = (
    64  # rows of products whose batch is not a full one: each new shape costs a compilation of its product
)
LINE: Final = 64  # [bytes] of a cache line
DTYPES: Final[dict[Precision, torch.dtype]] = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def native_precision() -> Precision:
    """Return bfloat16 where the CPU multiplies it natively, and float32 elsewhere."""
    can = torch.cpu.get_capabilities()
    return "bfloat16" if can.get("avx512_bf16") or can.get("amx_bf16") else "float32"


def _bits(tensor: Tensor) -> npt.NDArray[Any]:
    """Return a tensor's memory as the kernels read it: float32, or the bits of bfloat16 (uint16)."""
    return (tensor.view(torch.uint16) if tensor.dtype is torch.bfloat16 else tensor).numpy()


class _Layer:
    """A linear layer with arrays of its own: inputs [hidden, observation, 1], outputs, and their gradients.

    Rows of inputs and weights begin at a cache line; the numbers that fill them up are zero.

    Args:
        linear: Its parameters.
        observed: How many numbers of the observation it takes after the hidden ones.
        rows: Largest batch.
        dtype: Of its products.
    """

    def __init__(self, linear: nn.Linear, observed: int, rows: int, dtype: torch.dtype) -> None:
        self.observed = observed
        self.hidden = linear.in_features - observed
        bias = linear.in_features
        width = -(-(bias + 1) // (LINE // dtype.itemsize)) * (LINE // dtype.itemsize)
        self.weights, self.gradient = (torch.zeros((linear.out_features, width), dtype=dtype) for _ in "wg")
        self.inputs = torch.zeros((rows, width), dtype=dtype)
        self.inputs[:, bias] = 1.0
        self.outputs, self.slope = (torch.zeros((rows, linear.out_features), dtype=dtype) for _ in "os")
        self.input_bits, self.output_bits, self.slope_bits = map(
            _bits, (self.inputs, self.outputs, self.slope)
        )
        # The parameters, and where the products have them and their gradients
        self.parameters = [linear.weight, linear.bias]
        self.places = [self.weights[:, :bias], self.weights[:, bias]]
        self.slopes = [self.gradient[:, :bias], self.gradient[:, bias]]

    def take(self, obs: Tensor) -> None:
        """Take the observations (n, ...) of a batch."""
        if self.observed:
            place(_bits(obs), self.observed, self.input_bits, self.hidden)

    def forward(self, count: int) -> Tensor:
        """Return the outputs (count, n) of the first ``count`` inputs."""
        return torch.mm(self.inputs[:count], self.weights.t(), out=self.outputs[:count])

    def backward(self, count: int) -> None:
        """Compute the parameters' gradients, given the outputs' slope."""
        torch.mm(self.slope[:count].t(), self.inputs[:count], out=self.gradient)

    def hidden_slope(self, count: int) -> Tensor:
        """Return the slope with respect to the hidden inputs (count, hidden)."""
        return torch.mm(self.slope[:count], self.weights[:, : self.hidden])


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

        def layer(linear: nn.Module, observed: int = 0) -> _Layer:
            if not isinstance(linear, nn.Linear):
                raise TypeError(f"{type(linear).__name__} as a layer; allowed: Linear")
            return _Layer(linear, observed, rows, self.dtype)

        self._trunk = [layer(linear, network.obs_size) for linear in network.trunk.layers]
        head = network.critic_head
        linears = [] if head is None else [part for part in head if isinstance(part, nn.Linear)]
        beyond_trunk = linears[0].in_features - network.trunk.out_features if linears else 0
        self._critic = [layer(linear, 0 if k else beyond_trunk) for k, linear in enumerate(linears)]
        self._mean, self._value = layer(network.mean), layer(network.value)
        policy, critic = [*self._trunk, self._mean], [*self._critic, self._value]
        layers = policy + critic
        self._parameters = [parameter for layer in layers for parameter in layer.parameters]
        self._places = [place for layer in layers for place in layer.places]
        self._slopes = [slope for layer in layers for slope in layer.slopes]
        self._policy_tensors = 2 * len(policy)
        # One array holds all gradients: the noise's, the policy's, the critic's
        self._learning = [network.log_std, *self._parameters]
        sizes = [parameter.numel() for parameter in self._learning]
        self._gradient = torch.zeros(sum(sizes))
        parts = torch.split(self._gradient, sizes)
        self._gradients = [part.view_as(of) for part, of in zip(parts, self._learning, strict=True)]
        self._count = 0  # observations of the last forward pass
        self._size = (
            0  # rows of its products: the observations, and rows of earlier batches that nobody reads
        )
        self.refresh()

    def gradient_of(self, learns_policy: bool, learns_noise: bool) -> tuple[Tensor, Tensor]:
        """Return the gradient of what learns (P,), and the noise's part of it: (A,), or (0,) if that does not learn.

        The parameters' ``grad`` are views of it from now on, and None where they do not learn.

        Args:
            learns_policy: Whether the policy learns, and not the critic alone.
            learns_noise: Whether the log standard deviation learns too.
        """
        first = 0 if learns_noise else 1 if learns_policy else 1 + self._policy_tensors
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
        obs = obs.to(self.dtype)
        count = len(obs)
        self._run_trunk(obs)
        chain = [*self._critic, self._value]
        for layer in chain:
            layer.take(obs)
        place(self._mean.input_bits[:count], self._mean.hidden, chain[0].input_bits, 0)
        self._run(chain, self._size)
        mean, value = (layer.forward(self._size)[:count] for layer in (self._mean, self._value))
        value = value.squeeze(-1)
        return mean.to(torch.float32, copy=True), value.to(torch.float32, copy=True)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Return mean actions (n, A), float32, as ``ActorCritic.act`` does.

        Args:
            obs: The policy's observations, normalised (n, obs_size), contiguous.
        """
        self._run_trunk(obs.to(self.dtype))
        return self._mean.forward(self._size)[: len(obs)].to(torch.float32, copy=True)

    def _run_trunk(self, obs: Tensor) -> None:
        """Run the trunk, up to the inputs of ``mean``."""
        self._count = count = len(obs)
        self._size = min(-(-count // SIZE_STEP) * SIZE_STEP, self.rows)
        chain = [*self._trunk, self._mean]
        for layer in chain:
            layer.take(obs)
        self._run(chain, self._size)

    @staticmethod
    def _run(layers: list[_Layer], count: int) -> None:
        """Run layers with ELU between them, up to the inputs of the last."""
        for layer, following in pairwise(layers):
            layer.forward(count)
            elu(layer.output_bits[:count], following.input_bits)

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
        self._value.slope[:count, 0] = 0.0 if value is None else value
        self._value.slope[count:size] = 0.0
        slope = self._back([*self._critic, self._value], size, is_needed=mean is not None)
        if mean is not None:
            self._mean.slope[:count] = mean
            self._mean.slope[count:size] = 0.0
            self._mean.backward(size)
            last = self._trunk[-1]
            torch.add(slope, self._mean.hidden_slope(size), out=last.slope[:size])
            elu_gradient(self._mean.input_bits, last.slope_bits[:size])
            self._back(self._trunk, size, is_needed=False)
        first = self._policy_tensors if mean is None else 0
        torch._foreach_copy_(self._gradients[1 + first :], self._slopes[first:])

    def _back(self, layers: list[_Layer], count: int, is_needed: bool) -> Tensor:
        """Compute the gradients of layers with ELU between them; return the slope of the first one's hidden inputs."""
        for before, layer in reversed(list(pairwise(layers))):
            layer.backward(count)
            torch.mm(layer.slope[:count], layer.weights[:, : layer.hidden], out=before.slope[:count])
            elu_gradient(layer.input_bits, before.slope_bits[:count])
        layers[0].backward(count)
        return layers[0].hidden_slope(count) if is_needed else torch.empty(0)
