"""The policy and the value function: one D2RL trunk, three heads.

The critic may see more than the policy: numbers behind those of the policy go to its head alone (an asymmetric
critic; Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning").
"""

import math
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Ge
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from common.policy.d2rl import D2RL
from common.policy.normalizer import Moments, scale_of

JUDGE_UNITS = (128, 64)  # hidden layers between trunk, truth and value of a privileged critic
LOG_2_PI = math.log(2.0 * math.pi)


class NetworkConfig(BaseModel):
    """The network's shape and start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: tuple[Annotated[int, Ge(1)], ...] = Field(
        (256, 128, 128, 64, 64, 32), min_length=1, description="widths of the D2RL trunk's hidden layers"
    )
    trunks: Literal["shared", "separate"] = Field(
        "shared", description="one trunk for actor and critic but the last layers, or one each"
    )
    initial_log_sigma: float = Field(-1.6, ge=-5, le=1, description="log of the action noise at the start")


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent sigma, and a normalised value.

    Args:
        obs_size: Width of what the policy sees, normalised.
        action_size: Width of the action.
        config: Shape and start.
        home_action: Action that holds the home pose (action_size,): the mean head's initial bias, so that
            training starts from a robot that stands still instead of one that flails.
        privileged_size: How many more numbers the critic sees.
    """

    def __init__(
        self,
        obs_size: int,
        action_size: int,
        config: NetworkConfig,
        home_action: np.ndarray,
        privileged_size: int = 0,
    ) -> None:
        super().__init__()
        self.obs_size = obs_size
        self.trunk = D2RL(obs_size, config.units)
        self.critic_trunk = D2RL(obs_size, config.units) if config.trunks == "separate" else None
        self.mean = nn.Linear(self.trunk.out_features, action_size)
        self.judge: nn.Sequential | None = None
        judged = self.trunk.out_features
        if privileged_size > 0:
            sizes = (judged + obs_size + privileged_size, *JUDGE_UNITS)
            layers = [(nn.Linear(i, o), nn.ELU()) for i, o in pairwise(sizes)]
            self.judge, judged = nn.Sequential(*(part for pair in layers for part in pair)), JUDGE_UNITS[-1]
        self.value = nn.Linear(judged, 1)
        self.log_sigma = nn.Parameter(torch.full((action_size,), config.initial_log_sigma))
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight, math.sqrt(2.0))
                nn.init.zeros_(module.bias)
        nn.init.orthogonal_(self.mean.weight, 0.01)
        nn.init.orthogonal_(self.value.weight, 1.0)
        with torch.no_grad():
            self.mean.bias.copy_(torch.as_tensor(home_action, dtype=torch.float32))

    @torch.no_grad()
    def renormalize(self, old: Moments, new: Moments) -> None:
        """Let the network, fed by ``new`` moments, do just what it did fed by ``old`` ones (but for the clip).

        W (x - m)/s + b = W' (x - m')/s' + b' with W' = W s'/s and b' = b + W (m' - m)/s, wherever x enters. It is
        what Pop-Art (van Hasselt et al. 2016) does for a value's scale, done at the inputs. An input that both moments
        clip enters as 5 before and after, and its weight still grows by s'/s: the scale's floor bounds that.
        """
        scale = scale_of(new) / scale_of(old)
        shift = (new.mean - old.mean) / scale_of(old)
        trunks = [trunk for trunk in (self.trunk, self.critic_trunk) if trunk is not None]
        fed: list[tuple[nn.Module, int]] = [
            (layer, self.obs_size) for trunk in trunks for layer in trunk.layers
        ]
        if self.judge is not None:
            fed.append((self.judge[0], len(scale)))
        for layer, seen in fed:  # the observation's columns are a layer's last
            if not isinstance(layer, nn.Linear):
                raise TypeError(f"{type(layer).__name__} takes the observation; allowed: Linear")
            weight = layer.weight[:, -seen:].double()
            layer.bias.add_((weight @ torch.from_numpy(shift[:seen])).float())
            layer.weight[:, -seen:] = (weight * torch.from_numpy(scale[:seen])).float()

    def policy_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that decide the actions."""
        return [*self.trunk.parameters(), *self.mean.parameters(), self.log_sigma]

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (N, A) and normalised values (N,) for what the critic sees, normalised (N, D)."""
        seen = obs[..., : self.obs_size]
        hidden = self.trunk(seen)
        critic = hidden if self.critic_trunk is None else self.critic_trunk(seen)
        if self.judge is not None:
            critic = self.judge(torch.cat((critic, obs), dim=-1))
        return self.mean(hidden), self.value(critic).squeeze(-1)

    def act(self, obs: Tensor) -> Tensor:
        """Return mean actions (N, A) for what the policy sees, normalised (N, obs_size)."""
        mean: Tensor = self.mean(self.trunk(obs))
        return mean


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
