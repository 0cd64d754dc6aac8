"""D2RL: a multi-layer perceptron whose hidden layers each take the observation again.

Sinha et al. 2020, "D2RL: Deep Dense Architectures in Reinforcement Learning": every hidden layer after the first
takes [previous layer's output, observation]; output layers take the last hidden layer alone.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class D2RL(nn.Module):
    """Hidden layers with ELU; the last layer's width is ``out_features``.

    Args:
        in_features: Width of the observation.
        units: Widths of the hidden layers, first to last.
    """

    def __init__(self, in_features: int, units: Sequence[int]) -> None:
        super().__init__()
        if not units:
            raise ValueError("D2RL without hidden layers: allowed are one or more widths")
        widths = [in_features, *(width + in_features for width in units[:-1])]
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip(widths, units, strict=True))
        self.out_features = units[-1]

    def forward(self, obs: Tensor) -> Tensor:
        """Return the last hidden layer's output (N, out_features) for ``obs`` (N, in_features)."""
        hidden: Tensor = nn.functional.elu(self.layers[0](obs))
        for layer in self.layers[1:]:
            hidden = nn.functional.elu(layer(torch.cat((hidden, obs), dim=-1)))
        return hidden
