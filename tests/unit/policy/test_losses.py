"""The losses' kernel against the formulas, with torch's autograd in float64."""

import numpy as np
import pytest
import torch

from common.policy.losses import Frames, LossWeights, Slopes, Sums, add_losses

ACTIONS = 7
COUNT = 300  # frames of the minibatch; other learners have some of them


def make_frames(count=200, seed=0, corrected=0.2):
    """Return frames, and mean actions, values and log standard deviations of a policy that has moved on."""
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return (scale * rng.normal(size=shape)).astype(np.float32)

    mean_prox, log_std = normal(count, ACTIONS), normal(ACTIONS, scale=0.3) - np.float32(1.5)
    actions = mean_prox + np.exp(log_std) * normal(count, ACTIONS)
    z = (actions - mean_prox) * np.exp(-log_std)
    log_prox = (-0.5 * z * z - log_std - 0.5 * np.log(2 * np.pi)).sum(-1).astype(np.float32)
    corrections = normal(count, ACTIONS, scale=0.1) * (rng.uniform(size=(count, 1)) < corrected)
    frames = Frames(
        actions,
        log_prox - normal(count, scale=0.5),
        log_prox,
        mean_prox,
        normal(count),
        normal(count),
        corrections.astype(np.float32),
    )
    mean = mean_prox + np.exp(log_std) * normal(count, ACTIONS, scale=0.2)
    return frames, (mean, normal(count), log_std + normal(ACTIONS, scale=0.05))


def make_weights(**changed):
    usual = {"clip": 0.2, "value": 1.5, "bound": 0.3, "correction": 0.0, "most_weight": 2.0}
    return LossWeights(**{**usual, "has_surrogate": True, "from_played": False, **changed})


def by_kernel(frames, policy, weights, count=COUNT):
    slopes = Slopes(*(np.full_like(array, np.nan) for array in policy))
    moved = np.full(ACTIONS, np.nan)
    return add_losses(*policy, frames, weights, count, *slopes, moved), slopes, moved


def by_autograd(frames, policy, weights, count=COUNT):
    """Return the losses' sums and slopes."""
    f = Frames(*(torch.from_numpy(array).double() for array in frames))
    mean, values, log_std = (torch.from_numpy(array).double().requires_grad_() for array in policy)
    log_new = torch.distributions.Normal(mean, log_std.exp()).log_prob(f.actions).sum(-1)
    ratio = torch.exp(log_new - f.log_prox)
    weight = torch.exp(f.log_prox - f.log_mu).clamp(max=weights.most_weight)
    clipped = ratio.clamp(1 - weights.clip, 1 + weights.clip)
    surrogate = -(weight * torch.minimum(ratio * f.advantages, clipped * f.advantages)).sum()
    value = 0.5 * (values - f.value_targets).square().sum()
    bound = (mean.abs() - 1.0).clamp(min=0.0).square().sum()
    acted = f.actions if weights.from_played else f.mean_prox
    is_corrected = (f.corrections != 0.0).any(-1, keepdim=True)
    correction = 0.5 * ((mean - acted - f.corrections).square() * is_corrected).sum()
    loss = weights.has_surrogate * surrogate + weights.value * value + weights.bound * bound
    (loss + weights.correction * correction).div(count).backward()
    sums = Sums(
        surrogate.item() * weights.has_surrogate,
        value.item(),
        bound.item(),
        correction.item() * (weights.correction > 0),
        float(((ratio - 1).abs() > weights.clip).sum()),
    )
    return sums, Slopes(*(of.grad.numpy() for of in (mean, values, log_std)))


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"correction": 40.0},
        {"correction": 40.0, "from_played": True, "has_surrogate": False},
        {"has_surrogate": False},
        {"clip": 0.01, "bound": 5.0},
    ],
)
def test_sums_and_slopes_are_autograds(changed):
    weights = make_weights(**changed)
    frames, policy = make_frames()
    sums, slopes, moved = by_kernel(frames, policy, weights)
    expected_sums, expected = by_autograd(frames, policy, weights)

    assert 0 < sums.outside < 200
    np.testing.assert_allclose(sums, expected_sums, rtol=1e-5)
    for got, exact in zip(slopes, expected, strict=True):
        if np.abs(exact).max() == 0.0:
            assert (got == 0.0).all()
        np.testing.assert_allclose(got, exact, atol=1e-5 * np.abs(exact).max(), rtol=1e-5)
    changes = policy[0].astype(np.float64) - frames.mean_prox
    np.testing.assert_allclose(moved, (changes * changes).sum(0), rtol=1e-6)


def frames_with_ratios(ratios, advantages, log_prox):
    """Return frames whose actions are the new policy's means, and that policy: its ratio to pi_prox is given.

    Its standard deviation is 1/sqrt(2 pi), so that the density of its mean is 1.
    """
    count = len(ratios)
    log_std = np.full(ACTIONS, -0.5 * np.log(2 * np.pi), np.float32)
    zeros = np.zeros((count, ACTIONS), np.float32)
    nothing = np.zeros(count, np.float32)
    log_prox = np.float32(log_prox) - np.log(np.array(ratios, np.float32))
    advantages = np.array(advantages, np.float32)
    frames = Frames(zeros, log_prox.copy(), log_prox, zeros, advantages, nothing, zeros)
    return frames, (zeros, nothing, log_std)


def test_the_surrogate_of_a_hand_worked_case():
    """Ratios 1.5 (clipped to 1.2), 0.5 (the advantage is negative, and min takes 0.8), 1.1."""
    frames, policy = frames_with_ratios((1.5, 0.5, 1.1), (2.0, -1.0, 3.0), 0.0)
    sums, *_ = by_kernel(frames, policy, make_weights())

    # min(1.5*2, 1.2*2) = 2.4; min(0.5*-1, 0.8*-1) = -0.8; 1.1*3 = 3.3
    assert sums.policy == pytest.approx(-(2.4 - 0.8 + 3.3), rel=1e-5)
    assert sums.outside == 2


def test_old_data_are_weighted_by_how_likely_they_still_are_at_most_twice():
    frames, policy = frames_with_ratios((1.0, 1.0), (1.0, 1.0), 0.0)
    frames = frames._replace(log_mu=-np.log(np.array([0.5, 8.0], np.float32)))
    sums, *_ = by_kernel(frames, policy, make_weights())

    assert sums.policy == pytest.approx(-(0.5 + 2.0), rel=1e-5)


def test_the_loss_of_targets_beyond_the_joints_range_is_their_squared_excess():
    frames, (_, values, log_std) = make_frames(2)
    mean = np.zeros((2, ACTIONS), np.float32)
    mean[0, :3], mean[1, 0] = (0.5, -1.0, 1.5), -3.0
    sums, slopes, _ = by_kernel(
        frames, (mean, values, log_std), make_weights(has_surrogate=False, bound=1.0), 2
    )

    assert sums.bound == 0.25 + 4.0
    assert slopes.mean[0].tolist() == [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    assert slopes.mean[1, 0] == -2.0


def test_a_frame_without_correction_is_not_pulled_and_a_zero_in_another_holds_the_action():
    frames, (mean, values, log_std) = make_frames(50)
    corrections = frames.corrections.copy()
    corrections[:, 2] = 0.0
    frames = frames._replace(corrections=corrections)
    weights = make_weights(has_surrogate=False, bound=0.0, correction=3.0)
    sums, slopes, _ = by_kernel(frames, (mean, values, log_std), weights)
    is_corrected = (corrections != 0.0).any(-1)

    assert 0 < is_corrected.sum() < 50
    assert (slopes.mean[~is_corrected] == 0.0).all()
    assert (slopes.mean[is_corrected, 2] != 0.0).all()
    off = (mean - frames.mean_prox - corrections)[is_corrected].astype(np.float64)
    assert sums.correction == pytest.approx(0.5 * (off * off).sum(), rel=1e-5)


def test_without_weight_corrections_are_not_looked_at():
    frames, policy = make_frames()
    sums, slopes, _ = by_kernel(frames, policy, make_weights())
    _, plain, _ = by_kernel(
        frames._replace(corrections=np.zeros_like(frames.corrections)), policy, make_weights(correction=40.0)
    )

    assert sums.correction == 0.0
    for one, other in zip(slopes, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_is_not_finite_reaches_the_slopes():
    frames, policy = make_frames(4)
    advantages = frames.advantages.copy()
    advantages[1] = np.nan
    _, slopes, _ = by_kernel(frames._replace(advantages=advantages), policy, make_weights())

    assert np.isnan(slopes.mean[1]).all()
    assert np.isfinite(slopes.mean[[0, 2, 3]]).all()
