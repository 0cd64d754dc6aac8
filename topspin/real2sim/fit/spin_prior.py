"""What is expected of spin and lift factor before a track is seen, and how both can change with equal lift.

The prior of the spin is a mixture of normal distributions of several widths: all directions are equal, slow balls are
more likely, and 900 rad/s are possible. The prior of the lift factor follows ``randomization.air_factors``: slow
backspin has more lift than the models say.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import BALL_RADIUS, GRAVITY
from common.physics.flight import Air, acceleration
from common.task.launch import LIFT_FACTOR, SPIN, VELOCITY
from common.task.randomization import SLOW_FROM, SLOW_TO
from topspin.real2sim.fit.fit_problem import HIGH, LOW

Array = npt.NDArray[np.float64]

RATE_STEPS: Final = (0.2, 0.8)  # [-] sigmas of the small and the large steps of the logarithm of the rate
SPIN_WIDTHS: Final = np.array([25.0, 50.0, 115.0, 250.0, 400.0])  # rad/s; of the prior's normal distributions
SPIN_SHARES: Final = np.array([0.35, 0.29, 0.20, 0.11, 0.05])  # [-] their shares: most balls spin slowly
# [-] mean and sigma of the prior of the lift factor, and what is added for slow backspin
LIFT, LIFT_BACKSPIN = (1.0, 0.15), (0.3, 0.15)
LIFT_RANGE: Final = (0.3, 1.95)  # [-]


def log_prior(values: Array) -> Array:
    """Return the log prior (n,) of the spins and lift factors of values (n, 13)."""
    spin, velocity, lift = values[:, SPIN], values[:, VELOCITY], values[:, LIFT_FACTOR]
    square = np.sum(spin**2, axis=1, keepdims=True)
    rate = np.sqrt(square[:, 0])
    parts = -0.5 * square / SPIN_WIDTHS**2 + np.log(SPIN_SHARES / SPIN_WIDTHS**3)
    most = parts.max(axis=1)
    log_spin = most + np.log(np.exp(parts - most[:, None]).sum(axis=1))
    flat = np.linalg.norm(velocity[:, :2], axis=1)
    back = np.maximum(spin[:, 0] * velocity[:, 1] - spin[:, 1] * velocity[:, 0], 0.0)
    speed = np.maximum(np.linalg.norm(velocity, axis=1), 1e-6)
    slowness = np.clip((BALL_RADIUS * rate / speed - SLOW_FROM) / (SLOW_TO - SLOW_FROM), 0.0, 1.0)
    share = slowness * back / np.maximum(flat * rate, 1e-6)
    mean, sigma = LIFT[0] + share * LIFT_BACKSPIN[0], LIFT[1] + share * LIFT_BACKSPIN[1]
    log_lift = -0.5 * ((lift - mean) / sigma) ** 2 - np.log(sigma)
    outside = (lift < LIFT_RANGE[0]) | (lift > LIFT_RANGE[1])
    outside |= np.any((spin < LOW[SPIN]) | (spin > HIGH[SPIN]), axis=1)
    return np.where(outside, -np.inf, log_spin + log_lift)


@kernel
def _lift_coefficients(speed: float, rates: Array, model: int, out: Array) -> None:
    """Write the lift per spin and speed [1] of balls of one speed and spin rates (n,), to a constant factor."""
    for k in range(rates.shape[0]):
        rate = max(rates[k], 1.0)
        there = acceleration((speed, 0.0, 0.0), (0.0, rate, 0.0), Air(0.0, 1.0, model))
        out[k] = max((-there[2] - GRAVITY) / (rate * speed), 1e-9)


class Ridge:
    """Moves along what a flight does not show: spin rate, spin along the flight, and lift factor at an equal lift.

    The lift is that of the mean velocity v: L = lift C(|v|, |w|) p, where p is the part of the spin across v. Its
    size and direction stay. The logarithm of the rate r changes, and the spin a along v or its share c = a / r. The
    volume element of spin and lift factor is r^2 / (C p) of that of L, log r and a, or r^3 / (C p) of that with c.
    """

    def __init__(self, velocity: Array, model: int) -> None:
        self._speed, self._model = float(np.linalg.norm(velocity)), model
        self._along = velocity / max(self._speed, 1e-6)

    def _coefficients(self, rates: Array) -> Array:
        out = np.empty_like(rates)
        _lift_coefficients(self._speed, rates, self._model, out)
        return out

    def _log_volume(self, spin: Array, power: Array) -> Array:
        rate = np.maximum(np.linalg.norm(spin, axis=1), 1e-3)
        across = np.maximum(np.linalg.norm(spin - np.outer(spin @ self._along, self._along), axis=1), 1e-6)
        return np.asarray(power * np.log(rate) - np.log(self._coefficients(rate) * across))

    def move(self, values: Array, rng: np.random.Generator) -> Array:
        """Move the spins and lift factors of values (n, 13); return the log of the ratio of the volumes (n,)."""
        spin, n = values[:, SPIN].copy(), len(values)
        rate = np.maximum(np.linalg.norm(spin, axis=1), 1e-3)
        along = spin @ self._along
        across = spin - np.outer(along, self._along)
        size = np.maximum(np.linalg.norm(across, axis=1), 1e-6)
        lift = values[:, LIFT_FACTOR] * self._coefficients(rate) * size
        scale = np.where(rng.uniform(size=n) < 0.5, *RATE_STEPS)
        new_rate = rate * np.exp(scale * rng.standard_normal(n))
        share = along / rate + 0.2 * rng.standard_normal(n)
        share = np.where(rng.uniform(size=n) < 0.5, rng.uniform(-1.0, 1.0, n), share)
        # half of them keep the spin along the flight, which a bounce shows
        keeps = rng.uniform(size=n) < 0.5
        new_along = np.where(keeps, along, new_rate * share)
        possible = np.abs(new_along) < new_rate
        new_along = np.where(possible, new_along, 0.0)
        new_size = np.sqrt(new_rate**2 - new_along**2)
        moved = across * (new_size / size)[:, None] + np.outer(new_along, self._along)
        values[:, SPIN] = moved
        values[:, LIFT_FACTOR] = lift / (self._coefficients(new_rate) * np.maximum(new_size, 1e-6))
        power = np.where(keeps, 2.0, 3.0)
        ratio = self._log_volume(moved, power) - self._log_volume(spin, power)
        return np.where(possible, ratio, -np.inf)
