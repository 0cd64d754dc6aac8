"""A network's parameters and moments on the wire: safetensors blobs, checked before they are loaded. No pickle."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from common.comms.messages import PolicySnapshot
from common.policy.actor_critic import ActorCritic
from common.policy.config import NetworkConfig
from common.policy.contract import PolicyError
from common.policy.network_pass import DTYPES, Precision
from common.policy.normalizer import Moments
from common.task.observation import (
    ACTION_SIZE,
    PAPER_OBSERVATION,
    ObservationConfig,
    Part,
    critic_layout,
    policy_layout,
    size,
)


def new_network(
    config: NetworkConfig,
    observation: ObservationConfig = PAPER_OBSERVATION,
    home_action: npt.NDArray[np.float32] | None = None,
) -> ActorCritic:
    """Return a new network for the observations of policy and critic."""
    home = np.zeros(ACTION_SIZE, np.float32) if home_action is None else home_action
    own, all_ = size(policy_layout(observation)), size(critic_layout(observation))
    return ActorCritic(own, ACTION_SIZE, config, home, all_ - own)


def state_tensors(network: ActorCritic) -> dict[str, npt.NDArray[np.float32]]:
    """Return the network's parameters by name, as copies."""
    return {name: value.detach().numpy().copy() for name, value in network.state_dict().items()}


def pack(network: ActorCritic, precision: Precision = "float32") -> bytes:
    """Return the network's parameters as a safetensors blob, matrices in ``precision``."""
    return save_tensors(
        {
            name: value.detach().to(DTYPES[precision]) if value.ndim > 1 else value.detach()
            for name, value in network.state_dict().items()
        }
    )


def unpack(network: ActorCritic, blob: bytes) -> None:
    """Load a blob of ``pack`` into ``network``; raises PolicyError where it doesn't fit."""
    try:
        tensors = load_tensors(blob)
    except (SafetensorError, ValueError, KeyError) as error:  # KeyError: a dtype that PyTorch lacks
        raise PolicyError(f"weights are not readable as safetensors: {error}") from None
    arrays = {
        name: (value.float() if value.dtype == torch.bfloat16 else value).numpy()  # which numpy lacks
        for name, value in tensors.items()
    }
    load_state(network, arrays)


def load_state(network: ActorCritic, tensors: Mapping[str, npt.NDArray[Any]]) -> None:
    """Load parameters by name; raises PolicyError with the first that is missing, unknown or of a wrong shape."""
    own = network.state_dict()
    for name in own.keys() - tensors.keys():
        raise PolicyError(f"weights lack {name!r}; the network has {', '.join(sorted(own))}")
    for name, value in tensors.items():
        if name not in own:
            raise PolicyError(f"weights hold unknown {name!r}; the network has {', '.join(sorted(own))}")
        if tuple(own[name].shape) != value.shape:
            raise PolicyError(
                f"weights {name!r} have shape {value.shape}; allowed is {tuple(own[name].shape)}"
            )
        if value.dtype.kind != "f":
            raise PolicyError(f"weights {name!r} are {value.dtype}; allowed are floating-point numbers")
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(value.astype(np.float32)).all()
        if not is_finite:
            raise PolicyError(f"weights {name!r} are not finite")
    network.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in tensors.items()})


def observation_moments(
    mean: npt.NDArray[Any], var: npt.NDArray[Any], count: npt.ArrayLike, layout: tuple[Part, ...]
) -> Moments:
    """Return the moments that came with a policy; raises PolicyError if they are not those of ``layout``."""
    allowed = (size(layout),)
    if not mean.shape == var.shape == allowed:
        raise PolicyError(f"observation moments of shapes {mean.shape} and {var.shape}; allowed is {allowed}")
    _check("obs_moments.mean", mean, np.isfinite(mean), "finite numbers")
    _check("obs_moments.var", var, np.isfinite(var) & (var >= 0), "finite numbers that are not negative")
    number = np.asarray(count)
    if number.shape != () or number.dtype.kind not in "iu" or number < 1:
        raise PolicyError(f"obs_moments.count is {number.tolist()!r:.60}; allowed is one whole number from 1")
    return Moments(mean.astype(np.float64), var.astype(np.float64), int(number))


def _check(name: str, values: npt.NDArray[Any], is_good: npt.NDArray[np.bool_], allowed: str) -> None:
    """Raise PolicyError with the first value that is not good."""
    if not is_good.all():
        worst = int(np.argmin(is_good))
        raise PolicyError(f"{name}[{worst}] is {values[worst]}; allowed are {allowed}")


def install(
    network: ActorCritic, snapshot: PolicySnapshot, layout: tuple[Part, ...], allowed: str, role: str
) -> Moments:
    """Load a policy that came over the wire into ``network``, and return its normaliser's moments.

    Args:
        network: Written.
        snapshot: The policy.
        layout: What its critic observes.
        allowed: The receiver's ``training_hash`` (an actor) or ``contract_hash`` (an evaluator).
        role: Of the receiver, for the error's text.

    Raises:
        PolicyError: The policy is of another task or doesn't fit. ``network`` is unchanged.
    """
    if allowed not in (snapshot.contract_hash, snapshot.training_hash):
        raise PolicyError(
            f"policy has contract {snapshot.contract_hash} and training {snapshot.training_hash}, this {role} has "
            f"{allowed}: start both with the same [task], [network] and [experience] settings"
        )
    moments = observation_moments(snapshot.obs_mean, snapshot.obs_var, snapshot.obs_count, layout)
    unpack(network, snapshot.weights)
    return moments
