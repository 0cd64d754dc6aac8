"""The policy and the value function: one D2RL trunk, three heads.

The critic may observe more than the policy: its additional numbers go to its own head (an asymmetric
critic; Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning").
"""

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from common.policy.config import NetworkConfig
from common.policy.d2rl import D2RL
from common.policy.normalizer import Moments, scale_of

CRITIC_HEAD_UNITS = (
    128,
    64,
)  # hidden layers of a privileged critic: from the trunk's output and the truth to the value
LOG_2_PI = math.log(2.0 * math.pi)


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent standard deviation, and a normalised value.

    Args:
        obs_size: Width of the policy's observation, normalised.
        action_size: Width of the action.
        config: Shape and start.
        home_action: Action that holds the home pose (action_size,). It is the mean head's initial bias, so that
            the robot stands still when training starts.
        privileged_size: How many more numbers the critic observes.
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
        self.mean = nn.Linear(self.trunk.out_features, action_size)
        self.critic_head: nn.Sequential | None = None
        value_inputs = self.trunk.out_features
        if privileged_size > 0:
            sizes = (value_inputs + obs_size + privileged_size, *CRITIC_HEAD_UNITS)
            layers = [(nn.Linear(i, o), nn.ELU()) for i, o in pairwise(sizes)]
            self.critic_head, value_inputs = (
                nn.Sequential(*(part for pair in layers for part in pair)),
                CRITIC_HEAD_UNITS[-1],
            )
        self.value = nn.Linear(value_inputs, 1)
        self.log_std = nn.Parameter(torch.full((action_size,), config.initial_log_std))
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
        """Change the weights so that ``new`` moments give the same outputs as ``old`` ones did, up to the clip.

        W (x - m)/s + b = W' (x - m')/s' + b' with W' = W s'/s and b' = b + W (m' - m)/s, wherever x enters. Pop-Art
        (van Hasselt et al. 2016) does the same for a value's scale; here it is done at the inputs. An input that both
        moments clip is 5 before and after, but its weight still grows by s'/s. The scale's floor bounds that growth.
        """
        scale = scale_of(new) / scale_of(old)
        shift = (new.mean - old.mean) / scale_of(old)
        inputs: list[tuple[nn.Module, int]] = [(layer, self.obs_size) for layer in self.trunk.layers]
        if self.critic_head is not None:
            inputs.append((self.critic_head[0], len(scale)))
        for layer, width in inputs:  # the observation's columns are a layer's last
            if not isinstance(layer, nn.Linear):
                raise TypeError(f"{type(layer).__name__} takes the observation; allowed: Linear")
            weight = layer.weight[:, -width:].double()
            layer.bias.add_((weight @ torch.from_numpy(shift[:width])).float())
            layer.weight[:, -width:] = (weight * torch.from_numpy(scale[:width])).float()

    def policy_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that decide the actions."""
        return [*self.trunk.parameters(), *self.mean.parameters(), self.log_std]

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (N, A) and normalised values (N,) for the critic's observations, normalised (N, D)."""
        hidden = self.trunk(obs[..., : self.obs_size])
        critic = hidden
        if self.critic_head is not None:
            critic = self.critic_head(torch.cat((hidden, obs), dim=-1))
        return self.mean(hidden), self.value(critic).squeeze(-1)

    def act(self, obs: Tensor) -> Tensor:
        """Return mean actions (N, A) for the policy's observations, normalised (N, obs_size)."""
        mean: Tensor = self.mean(self.trunk(obs))
        return mean


def log_prob(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return log N(actions; mean, std) summed over the action (N,)."""
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * (z * z).sum(-1) - log_std.sum() - 0.5 * actions.shape[-1] * LOG_2_PI


def entropy(log_std: Tensor) -> Tensor:
    """Return the Gaussian's differential entropy [nats]."""
    return log_std.sum() + 0.5 * log_std.shape[-1] * (1.0 + LOG_2_PI)
