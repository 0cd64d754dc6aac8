"""The policy and the value function: one D2RL trunk, three heads."""

import math
from typing import Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from common.policy.d2rl import D2RL

LOG_2_PI = math.log(2.0 * math.pi)


class NetworkConfig(BaseModel):
    """The network's shape and start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: tuple[int, ...] = Field(
        (256, 128, 128, 64, 64, 32), min_length=1, description="widths of the D2RL trunk's hidden layers"
    )
    trunks: Literal["shared", "separate"] = Field(
        "shared", description="one trunk for actor and critic but the last layers, or one each"
    )
    initial_log_sigma: float = Field(-1.6, ge=-5, le=1, description="log of the action noise at the start")


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent sigma, and a normalised value.

    Args:
        obs_size: Width of the (normalised) observation.
        action_size: Width of the action.
        config: Shape and start.
        home_action: Action that holds the home pose (action_size,): the mean head's initial bias, so that
            training starts from a robot that stands still instead of one that flails.
    """

    def __init__(
        self, obs_size: int, action_size: int, config: NetworkConfig, home_action: np.ndarray
    ) -> None:
        super().__init__()
        self.trunk = D2RL(obs_size, config.units)
        self.critic_trunk = D2RL(obs_size, config.units) if config.trunks == "separate" else None
        self.mean = nn.Linear(self.trunk.out_features, action_size)
        self.value = nn.Linear(self.trunk.out_features, 1)
        self.log_sigma = nn.Parameter(torch.full((action_size,), config.initial_log_sigma))
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight, math.sqrt(2.0))
                nn.init.zeros_(module.bias)
        nn.init.orthogonal_(self.mean.weight, 0.01)
        nn.init.orthogonal_(self.value.weight, 1.0)
        with torch.no_grad():
            self.mean.bias.copy_(torch.as_tensor(home_action, dtype=torch.float32))

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (N, A) and normalised values (N,) for normalised observations (N, D)."""
        hidden = self.trunk(obs)
        critic = hidden if self.critic_trunk is None else self.critic_trunk(obs)
        return self.mean(hidden), self.value(critic).squeeze(-1)


def log_prob(actions: Tensor, mean: Tensor, log_sigma: Tensor) -> Tensor:
    """Return log N(actions; mean, sigma) summed over the action (N,)."""
    z = (actions - mean) * torch.exp(-log_sigma)
    return -0.5 * (z * z).sum(-1) - log_sigma.sum() - 0.5 * actions.shape[-1] * LOG_2_PI


def entropy(log_sigma: Tensor) -> Tensor:
    """Return the Gaussian's differential entropy [nats]."""
    return log_sigma.sum() + 0.5 * log_sigma.shape[-1] * (1.0 + LOG_2_PI)


def kl_divergence(mean_p: Tensor, log_sigma_p: Tensor, mean_q: Tensor, log_sigma_q: Tensor) -> Tensor:
    """Return KL(p || q) of two diagonal Gaussians, averaged over the batch."""
    variance_q = torch.exp(2.0 * log_sigma_q)
    spread = (torch.exp(2.0 * log_sigma_p) + (mean_p - mean_q) ** 2) / (2.0 * variance_q)
    return (log_sigma_q - log_sigma_p + spread - 0.5).sum(-1).mean()
