"""The least-squares problem of ``identify.fit``: unknowns, priors and residuals."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from common.physics.constants import TABLE_FRICTION, TABLE_RESTITUTION0
from common.physics.flight import FULL
from common.task.launch import DRAG_FACTOR, LIFT_FACTOR, SPIN
from topspin.real2sim.fit.predict import predict, whitened
from topspin.real2sim.formats.tracks import Array, Track

Integers = npt.NDArray[np.int64]

# Layout of the unknowns: the launch's eleven numbers, then the table's two
FLOWN: Final = LIFT_FACTOR + 1  # numbers of a launch that decide its flight: all but the kind
RESTITUTION0: Final = FLOWN  # [-] e_0
FRICTION: Final = FLOWN + 1  # [-] mu
UNKNOWNS: Final = FLOWN + 2

NO_TABLE: Final = np.empty(0)
# Their scales, so that a step of one is equally large in each
UNITS: Final = np.array([0.01] * 3 + [0.1] * 3 + [20.0] * 3 + [0.1] * 2 + [0.02, 0.05])
LOW: Final = np.array([-10.0] * 3 + [-50.0] * 3 + [-2000.0] * 3 + [0.2, 0.0, 0.7, 0.02])
# ``fly.py`` bounds the air's force by factors below 2
HIGH: Final = np.array([10.0] * 3 + [50.0] * 3 + [2000.0] * 3 + [1.95, 1.95, 1.15, 0.6])
STEP: Final = 1e-4  # [UNITS] of a slope of the residuals
MOST_STEPS: Final = 80  # of a search; at the kinks of the full model's lift it may creep for thousands
ROBUST_FROM: Final = 2.0  # [sigma] beyond it the loss grows more slowly than the square


class Air(StrEnum):
    """Which forces of the air the fitted model has."""

    ALL = "all"
    DRAG = "drag"  # no Magnus force: the flight of a ball without spin
    NONE = "none"  # gravity alone


FREE: Final[dict[Air, Integers]] = {
    Air.ALL: np.arange(FLOWN),
    Air.DRAG: np.array([*range(6), DRAG_FACTOR]),
    Air.NONE: np.arange(6),
}


@dataclass(frozen=True, slots=True)
class FitOptions:
    """What is fitted, and the priors. Those of spin and lift lead the search; the result has ``spin_prior``'s."""

    air: Air = Air.ALL
    flight: int = FULL  # flight.SIMPLE or flight.FULL
    through_bounce: bool = True  # False: samples before the first bounce only
    position_sigma: float = 1.0e-3  # m; of a sample, across its path; real cameras: 0.5 to 1.2 mm
    timing_sigma: float = 0.35e-3  # s; of a time stamp: 1.9 mm along the path at 5.5 m/s
    spin_sigma: float = 150.0  # rad/s; prior of each component, about zero
    drag_sigma: float = 0.2  # [-] prior of the drag factor, about 1
    lift_sigma: float = 0.25  # [-] prior of the lift factor, about 1
    restitution0: float = TABLE_RESTITUTION0  # [-] prior of the table's e_0
    restitution0_sigma: float = 0.02  # [-]
    friction: float = TABLE_FRICTION  # [-] prior of the table's mu
    friction_sigma: float = 0.04  # [-]


class Problem:
    """Residuals of samples and priors as a function of the free unknowns.

    Args:
        track: Samples to explain.
        options: Priors and noise.
        bounces: Whether the table is in the model; its restitution and friction are then unknown too.
        start: (13,) the values; those that are not free keep them.
        noise: Sigma of a position [m] and of a time stamp [s]; those of ``options`` by default.
    """

    def __init__(
        self,
        track: Track,
        options: FitOptions,
        bounces: bool,
        start: Array,
        noise: tuple[float, float] | None = None,
    ) -> None:
        self.track, self.options, self.bounces = track, options, bounces
        self.start = start
        self.noise = noise or (options.position_sigma, options.timing_sigma)
        self.free = FREE[options.air]
        if bounces:
            self.free = np.append(self.free, [RESTITUTION0, FRICTION])
        self.predicted, self.velocities = np.empty_like(track.positions), np.empty_like(track.positions)
        self._residuals = np.empty_like(track.positions)
        self.prior_mean, self.prior_sigma = np.zeros(UNKNOWNS), np.full(UNKNOWNS, np.inf)
        self.prior_mean[DRAG_FACTOR], self.prior_sigma[DRAG_FACTOR] = 1.0, options.drag_sigma
        self.prior_mean[LIFT_FACTOR], self.prior_sigma[LIFT_FACTOR] = 1.0, options.lift_sigma
        self.prior_sigma[SPIN] = options.spin_sigma
        self.prior_mean[RESTITUTION0], self.prior_sigma[RESTITUTION0] = (
            options.restitution0,
            options.restitution0_sigma,
        )
        self.prior_mean[FRICTION], self.prior_sigma[FRICTION] = options.friction, options.friction_sigma
        self.held = self.free[np.isfinite(self.prior_sigma[self.free])]

    def values(self, unknowns: Array) -> Array:
        """Return all values (13,) for these free unknowns [UNITS]."""
        values = self.start.copy()
        values[self.free] = unknowns * UNITS[self.free]
        return values

    def residuals(self, unknowns: Array) -> Array:
        """Return the residuals [sigmas] of the samples, x, y and z in turn, and of the priors."""
        values = self.values(unknowns)
        table = values[RESTITUTION0:] if self.bounces else NO_TABLE
        predict(
            values[:FLOWN],
            table,
            self.options.flight,
            self.track.times,
            self.predicted,
            self.velocities,
        )
        whitened(
            self.predicted,
            self.velocities,
            self.track.positions,
            *self.noise,
            self._residuals,
        )
        held = self.held
        priors = (values[held] - self.prior_mean[held]) / self.prior_sigma[held]
        return np.append(self._residuals.ravel(), priors)

    def solve(self, start: Array) -> Any:
        """Return scipy's result from the start values (13,)."""
        low, high = (LOW / UNITS)[self.free], (HIGH / UNITS)[self.free]
        begin = np.clip((start / UNITS)[self.free], low + 1e-6, high - 1e-6)
        return least_squares(
            self.residuals,
            begin,
            bounds=(low, high),
            loss="soft_l1",
            f_scale=ROBUST_FROM,
            max_nfev=MOST_STEPS,
        )

    def covariance(self, unknowns: Array) -> Array:
        """Return the values' covariance (13, 13) from the Jacobian. For fast spin, ``spin_posterior`` is right."""
        here = self.residuals(unknowns)
        columns = []
        for k in range(len(unknowns)):
            moved = unknowns.copy()
            moved[k] += STEP
            columns.append((self.residuals(moved) - here) / STEP)
        jacobian = np.stack(columns, axis=1)
        units = UNITS[self.free]
        covariance = np.zeros((UNKNOWNS, UNKNOWNS))
        covariance[np.ix_(self.free, self.free)] = np.linalg.pinv(jacobian.T @ jacobian) * np.outer(
            units, units
        )
        return covariance
