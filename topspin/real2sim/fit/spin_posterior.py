"""What a track shows of spin and lift: samples of their posterior distribution.

A flight shows the product of lift factor and spin, and the lift's saturation makes several rates fit equally well. So
the slope of the residuals at the best fit gives sigmas that are many times too small. Here parallel chains
(differential evolution Markov chains, ter Braak 2006) walk over spin and lift factor. The other unknowns are nearly
linear: for each spin they are solved by Newton's method with the slopes of the best fit, and their own covariance is
added. Each chain proposes the difference of two others, so the steps adapt to the distribution's shape.

Priors, and moves along what a flight does not show: ``spin_prior``.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.task.launch import LIFT_FACTOR, SPIN, VELOCITY
from topspin.real2sim.fit.fit_problem import (
    FLOWN,
    HIGH,
    LOW,
    ROBUST_FROM,
    UNITS,
    Problem,
)
from topspin.real2sim.fit.predict import advance
from topspin.real2sim.fit.spin_prior import LIFT_RANGE, Ridge, log_prior

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

BLOCK: Final = 0.02  # s; samples are averaged over so long, and a ball moves in steps of at most this
CHAINS: Final = 24
STEPS: Final = 360  # of each chain
WARM_UP: Final = 110  # of them, which are not used
COOLING: Final = 50  # first steps, in which the likelihood counts less
COLD: Final = (
    12.0  # [-] in the warm-up a chain so far below the best in log density restarts from a better one
)
LONG_JUMP: Final = 7  # every so many steps proposals reach other modes
INNER_STEPS: Final = 1  # of Newton's method
FARTHEST: Final = 1e6  # [sigma] a larger residual counts as this
TYPICAL: Final = 6.0  # [-] twice the log likelihood: a launch so far below the best explains no track
_SAMPLED: Final = np.array([*range(SPIN.start, SPIN.stop), LIFT_FACTOR])


@dataclass(frozen=True, slots=True)
class SpinPosterior:
    """What a track shows.

    Attributes:
        values: (13,) launch and table of a ball that explains the track, with a spin in the middle of all that do.
        covariance: (13, 13) mean square deviations of the possible values from ``values``. Those of the spin are
            scaled: a component's sigma is a quarter of its interval. A long tail would make the mean square too large.
        spin_interval: (2, 3) [rad/s] bounds of each component of the spin: 2.5 % of the possible ones lie beyond each.
    """

    values: Array
    covariance: Array
    spin_interval: Array


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Averages over a few samples each, and how deviations from them count.

    Attributes:
        times: (m,) [s].
        positions: (m, 3) [m].
        weights: (m, 3, 3) from deviations [m] to sigmas.
    """

    times: Array
    positions: Array
    weights: Array


def _blocks(problem: Problem, best: Array, bounces: Array) -> _Blocks:
    """Return the track in blocks, none of which holds a bounce: the best fit plus the mean of its residuals."""
    residuals = problem.residuals(best)[: problem.predicted.size].reshape(-1, 3)
    t, s, s_t = problem.track.times, *problem.noise
    # of the robust loss, at the best fit
    trust = 1.0 / np.sqrt(1.0 + np.mean(residuals**2, axis=1) / ROBUST_FROM**2)
    off = problem.track.positions - problem.predicted
    segment = np.searchsorted(bounces, t, side="right")
    block = np.floor(t / BLOCK).astype(np.int64) + 1_000_000 * segment
    times, places, weights = [], [], []
    for number in np.unique(block):
        rows = block == number
        total = float(trust[rows].sum())
        middle = int(np.flatnonzero(rows)[rows.sum() // 2])
        velocity = problem.velocities[middle]
        along = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
        wide = np.hypot(s, s_t * float(np.linalg.norm(velocity)))
        share = np.outer(along, along)
        times.append(t[middle])
        places.append(problem.predicted[middle] + trust[rows] @ off[rows] / total)
        weights.append(np.sqrt(total) * ((np.eye(3) - share) / s + share / wide))
    return _Blocks(np.array(times), np.array(places), np.array(weights))


@kernel
def _deviations(
    values: Array, has_table: bool, model: int, times: Array, positions: Array, weights: Array, out: Array
) -> None:
    """Write the weighted deviations (n, 3 m) of balls with ``values`` (n, 13) from blocks (m, ...)."""
    for b in range(values.shape[0]):
        row = values[b]
        pos, vel, spin = (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8])
        table = row[FLOWN:] if has_table else row[:0]
        now = 0.0
        for k in range(times.shape[0]):
            steps = int(np.ceil((times[k] - now) / BLOCK - 1e-9))
            for _ in range(steps):
                h = (times[k] - now) / steps
                pos, vel, spin = advance(pos, vel, spin, h, row[9], row[10], model, table)
            now = times[k]
            for i in range(3):
                out[b, 3 * k + i] = (
                    weights[k, i, 0] * (pos[0] - positions[k, 0])
                    + weights[k, i, 1] * (pos[1] - positions[k, 1])
                    + weights[k, i, 2] * (pos[2] - positions[k, 2])
                )


class _Density:
    """Log density of spins and lift factors, with the other unknowns solved."""

    def __init__(self, problem: Problem, best: Array, blocks: _Blocks) -> None:
        self._problem, self._blocks = problem, blocks
        self.solved = np.setdiff1d(problem.free, _SAMPLED)
        self.best = problem.values(best)
        self._held = self.solved[np.isfinite(problem.prior_sigma[self.solved])]
        here = self._residuals(self.best[None])[0]
        columns = []
        for k in self.solved:
            moved = self.best.copy()
            step = 1e-3 * UNITS[k] * (-1.0 if self.best[k] + 1e-3 * UNITS[k] > HIGH[k] else 1.0)
            moved[k] += step
            columns.append((self._residuals(moved[None])[0] - here) / step)
        slopes = np.stack(columns, axis=1)
        self._normal = slopes.T @ slopes
        self.covariance = np.linalg.pinv(self._normal, hermitian=True)
        self._newton = self.covariance @ slopes.T

    def _residuals(self, values: Array) -> Array:
        """Return residuals (n, r) [sigmas] of the blocks and of the priors of the solved unknowns."""
        blocks, problem = self._blocks, self._problem
        out = np.empty((len(values), 3 * len(blocks.times)))
        _deviations(
            values,
            problem.bounces,
            problem.options.flight,
            blocks.times,
            blocks.positions,
            blocks.weights,
            out,
        )
        priors = (values[:, self._held] - problem.prior_mean[self._held]) / problem.prior_sigma[self._held]
        found: Array = np.clip(np.nan_to_num(np.hstack((out, priors)), nan=FARTHEST), -FARTHEST, FARTHEST)
        return found

    def of(self, values: Array) -> tuple[Array, Array, Array]:
        """Return values (n, 13) with the other unknowns solved, log likelihoods (n,) and log priors (n,)."""
        values = values.copy()
        for _ in range(INNER_STEPS):
            values[:, self.solved] -= self._residuals(values) @ self._newton.T
            values[:, self.solved] = np.clip(values[:, self.solved], LOW[self.solved], HIGH[self.solved])
        residuals = self._residuals(values)
        step = residuals @ self._newton.T
        cost = np.sum(residuals**2, axis=1) - np.einsum("ni,ij,nj->n", step, self._normal, step)
        return values, -0.5 * cost, log_prior(values)


def _first(best: Array, rng: np.random.Generator) -> Array:
    """Return where the chains start (CHAINS, 13): near the best fit, and along what a flight does not show."""
    starts = np.tile(best, (CHAINS, 1))
    half = CHAINS // 2
    factor = np.exp(rng.uniform(np.log(0.4), np.log(5.0), half))
    starts[half:, SPIN] *= factor[:, None]
    starts[:half, SPIN] += 2.0 * rng.standard_normal((half, 3))
    starts[half:, SPIN] += 25.0 * rng.standard_normal((half, 3))
    velocity = best[VELOCITY] / max(float(np.linalg.norm(best[VELOCITY])), 1e-6)
    starts[half:, SPIN] += 60.0 * rng.standard_normal((half, 1)) * velocity
    starts[:, LIFT_FACTOR] = np.clip(
        starts[:, LIFT_FACTOR] + 0.05 * rng.standard_normal(CHAINS), LIFT_RANGE[0], LIFT_RANGE[1]
    )
    starts[:, SPIN] = np.clip(starts[:, SPIN], 0.75 * LOW[SPIN], 0.75 * HIGH[SPIN])
    return starts


def _walk(density: _Density, ridge: Ridge, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return sampled values (n, 13), their log likelihoods (n,) and their log priors (n,)."""
    now, likelihood, prior = density.of(_first(density.best, rng))
    kept: list[Array] = []
    kept_likelihood: list[Array] = []
    kept_prior: list[Array] = []
    small = 1e-3 * UNITS[_SAMPLED]
    for step in range(STEPS):
        weight = min(1.0, 0.02 * 50.0 ** (step / COOLING))
        one, other = _pairs(rng)
        volume: Array | float = 0.0
        length = 1.0 if step % LONG_JUMP == 0 else 2.38 / np.sqrt(2.0 * len(_SAMPLED)) * rng.uniform(0.5, 1.1)
        tried = now.copy()
        # the solved unknowns start where the same difference takes them
        tried += length * (now[one] - now[other])
        tried[:, _SAMPLED] += small * rng.standard_normal((CHAINS, len(_SAMPLED)))
        if step % 2:
            tried = now.copy()
            volume = ridge.move(tried, rng)
        tried[:, density.solved] = np.clip(
            tried[:, density.solved], LOW[density.solved], HIGH[density.solved]
        )
        tried, its_likelihood, its_prior = density.of(tried)
        gain = weight * (its_likelihood - likelihood) + its_prior - prior + volume
        accepted = np.log(rng.uniform(size=CHAINS)) < gain
        now[accepted] = tried[accepted]
        likelihood[accepted], prior[accepted] = its_likelihood[accepted], its_prior[accepted]
        if step < WARM_UP:
            if step >= COOLING and step % 10 == 0:
                total = likelihood + prior
                lost = np.flatnonzero(total < total.max() - COLD)
                good = np.flatnonzero(total >= total.max() - COLD)
                taken = rng.choice(good, len(lost))
                now[lost], likelihood[lost], prior[lost] = now[taken], likelihood[taken], prior[taken]
        else:
            kept.append(now.copy())
            kept_likelihood.append(likelihood.copy())
            kept_prior.append(prior.copy())
    return np.concatenate(kept), np.concatenate(kept_likelihood), np.concatenate(kept_prior)


def _pairs(rng: np.random.Generator) -> tuple[Integers, Integers]:
    """Return two other chains for each chain, all three different."""
    first = rng.integers(1, CHAINS, CHAINS)
    second = rng.integers(1, CHAINS - 1, CHAINS)
    second += second >= first
    chains = np.arange(CHAINS)
    return (chains + first) % CHAINS, (chains + second) % CHAINS


def spin_posterior(problem: Problem, best: Array, bounces: Array, seed: int = 0) -> SpinPosterior:
    """Return what a track shows of its ball's spin. Equal arguments give equal bits.

    Args:
        problem: Its least squares, of all forces.
        best: Their solution: the free unknowns [UNITS].
        bounces: (n,) [s] moments of the table bounces in the problem's track.
        seed: Of the chains.
    """
    density = _Density(problem, best, _blocks(problem, best, bounces))
    problem.residuals(best)
    ridge = Ridge(problem.velocities.mean(axis=0), problem.options.flight)
    samples, likelihood, prior = _walk(density, ridge, np.random.default_rng(seed))
    # rates have a long tail: the median is near the truth of slow balls, the mean near that of fast ones
    middle = 0.5 * (np.median(samples, axis=0) + samples.mean(axis=0))
    spread = np.cov(samples[:, _SAMPLED], rowvar=False) + np.diag((1e-6 * UNITS[_SAMPLED]) ** 2)
    off = samples[:, _SAMPLED] - middle[_SAMPLED]
    distance = np.einsum("ni,ij,nj->n", off, np.linalg.inv(spread), off)
    if problem.bounces:
        # of two groups of rates with the middle between them, the likelier one counts
        distance += (likelihood + prior).max() - (likelihood + prior)
    distance[2.0 * (likelihood.max() - likelihood) > TYPICAL] = np.inf
    values = samples[int(distance.argmin())]
    deviations = samples - values
    covariance = deviations.T @ deviations / len(samples)
    covariance[np.ix_(density.solved, density.solved)] += density.covariance
    interval = np.quantile(samples[:, SPIN], (0.025, 0.975), axis=0)
    factors = np.ones(len(covariance))
    factors[SPIN] = 0.25 * (interval[1] - interval[0]) / np.maximum(np.sqrt(np.diag(covariance)[SPIN]), 1e-9)
    return SpinPosterior(values, covariance * np.outer(factors, factors), interval)
