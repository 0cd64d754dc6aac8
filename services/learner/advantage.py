"""Generalised advantage estimation over one contiguous [T, B] block (Schulman et al. 2016, eq. 16)."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


def gae(
    rewards: Floats,
    values: Floats,
    terminated: Flags,
    truncated: Flags,
    final_values: Floats,
    last_values: Floats,
    gamma: float,
    lam: float,
) -> Floats:
    """Return advantages (T, B).

    Args:
        rewards: r_t (T, B).
        values: V(s_t) (T, B).
        terminated: The rules ended the episode at t: the value after it is 0 (T, B).
        truncated: The time limit ended the episode at t: bootstrap from the real last observation (T, B).
        final_values: V(s') where truncated, any number elsewhere (T, B).
        last_values: V of the observation after the block (B,).
        gamma: Discount.
        lam: Trace decay.
    """
    steps = len(rewards)
    following = np.empty_like(values)
    following[:-1] = values[1:]
    following[-1] = last_values
    following = np.where(truncated, final_values, following)
    following = np.where(terminated, np.float32(0), following)
    delta = rewards + np.float32(gamma) * following - values
    trace = np.where(terminated | truncated, np.float32(0), np.float32(gamma * lam))
    advantages = np.empty_like(values)
    running = np.zeros_like(last_values)
    for t in range(steps - 1, -1, -1):
        running = delta[t] + trace[t] * running
        advantages[t] = running
    return advantages
