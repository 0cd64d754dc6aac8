"""The losses of a minibatch and their slopes, in one pass over its frames: the update's own loop.

What a frame adds to the loss, with everything divided by the number of frames of the minibatch:

    - w min(r A, clip(r, 1 - eps, 1 + eps) A)              PPO's clipped surrogate, w the weight of old data
    + value_weight / 2 (V - target)^2
    + bound_weight sum_j max(|mean_j| - 1, 0)^2            targets that no joint can reach
    + correction_weight / 2 |mean - acted - correction|^2  where the frame has a correction

Its slopes with respect to mean actions, values and log standard deviations are written out: autograd takes a tenth of
an update for them (ADR-0062).
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.policy.actor_critic import LOG_2_PI

Floats = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]


class Frames(NamedTuple):
    """The frames of a minibatch, n of them."""

    actions: Floats  # (n, A)
    log_mu: Floats  # (n,) log probability of the action by the policy that played
    log_prox: Floats  # (n,) by the policy before this update
    mean_prox: Floats  # (n, A) mean action of that policy
    advantages: Floats  # (n,)
    value_targets: Floats  # (n,) normalised
    corrections: Floats  # (n, A) a row of zeros: none


class LossWeights(NamedTuple):
    """What the losses count, and what belongs to them."""

    clip: float  # trust region of the probability ratio
    value: float
    bound: float
    correction: float  # 0: corrections are not looked at
    most_weight: float  # clip of pi_prox / mu
    has_surrogate: bool  # whether the policy learns from the rewards
    from_played: bool  # a correction is relative to the played action; otherwise to the mean action of before


class Slopes(NamedTuple):
    """Slopes of the loss, with room for n frames or more."""

    mean: Floats  # (n, A) with respect to the mean actions
    value: Floats  # (n,) to the values
    log_std: Floats  # (A,) to the log standard deviations


class Sums(NamedTuple):
    """Sums over the frames of a minibatch."""

    policy: float  # surrogate loss
    value: float  # the losses here are without their weights
    bound: float
    correction: float
    outside: float  # frames whose probability ratio is outside of the trust region


@kernel
def add_losses(
    mean: Any,
    values: Any,
    log_std: Any,
    frames: Any,
    weights: Any,
    count: int,
    mean_slope: Any,
    value_slope: Any,
    log_std_slope: Any,
    moved: Any,
) -> Any:
    """Return the losses' sums, and write their slopes.

    Args:
        mean: Mean actions (n, A).
        values: Values (n,), normalised.
        log_std: (A,).
        frames: ``Frames``.
        weights: ``LossWeights``.
        count: Frames that the slopes' mean is over: more than n where other learners have the rest.
        mean_slope: Written (n, A).
        value_slope: Written (n,).
        log_std_slope: Written (A,).
        moved: Written (A,): sum of the squared changes of the mean action.
    """
    rows, size = mean.shape
    policy = value = bound = correction = outside = 0.0
    inverse_std = np.exp(-log_std.astype(np.float64))
    normaliser = log_std.astype(np.float64).sum() + 0.5 * size * LOG_2_PI
    log_std_slope[:] = 0.0
    moved[:] = 0.0
    z, noise_slope = np.empty(size), np.zeros(size)
    for i in range(rows):
        squares = 0.0
        is_corrected = False
        for j in range(size):
            z[j] = (frames.actions[i, j] - mean[i, j]) * inverse_std[j]
            squares += z[j] * z[j]
            is_corrected = is_corrected or frames.corrections[i, j] != 0.0
        log_prox, advantage = float(frames.log_prox[i]), float(frames.advantages[i])
        ratio = np.exp(-0.5 * squares - normaliser - log_prox)
        is_outside = abs(ratio - 1.0) > weights.clip
        outside += is_outside
        log_slope = 0.0  # of the loss, with respect to the action's log probability
        if weights.has_surrogate:
            weight = min(np.exp(log_prox - frames.log_mu[i]), weights.most_weight)
            clipped = min(max(ratio, 1.0 - weights.clip), 1.0 + weights.clip) * advantage
            policy -= weight * min(ratio * advantage, clipped)
            if not (is_outside and clipped < ratio * advantage):
                log_slope = -weight * ratio * advantage / count
        error = float(values[i]) - frames.value_targets[i]
        value += 0.5 * error * error
        value_slope[i] = weights.value * error / count
        is_corrected = is_corrected and weights.correction > 0.0
        for j in range(size):
            m = float(mean[i, j])
            slope = log_slope * z[j] * inverse_std[j]
            noise_slope[j] += log_slope * (z[j] * z[j] - 1.0)
            excess = max(abs(m) - 1.0, 0.0)
            bound += excess * excess
            slope += 2.0 * weights.bound * (excess if m > 0.0 else -excess) / count
            if is_corrected:
                acted = frames.actions[i, j] if weights.from_played else frames.mean_prox[i, j]
                off = m - acted - frames.corrections[i, j]
                correction += 0.5 * off * off
                slope += weights.correction * off / count
            mean_slope[i, j] = slope
            change = m - frames.mean_prox[i, j]
            moved[j] += change * change
    log_std_slope[:] = noise_slope
    return Sums(policy, value, bound, correction, outside)
