"""How an actor leads its robots home after their hits: what the mean action should change by (ADR-0064)."""

from typing import Final

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

FARTHEST: Final = 0.02  # [half-range] of one change: longer ones outweigh what the policy learns from rewards


def way_home(mean: Floats, home: Floats) -> Floats:
    """Return how mean actions (n, 7) after the hit should differ (n, 7): towards home (7,) [half-range].

    Nothing that the robot does after its hit moves this ball. But the next one finds it where it is, and rewards say
    so late and faintly.
    """
    change = home - mean
    length = np.linalg.norm(change, axis=-1, keepdims=True)
    shorter: Floats = change * np.minimum(1.0, FARTHEST / np.maximum(length, FARTHEST))
    return shorter
