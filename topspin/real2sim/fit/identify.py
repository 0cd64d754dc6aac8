"""From a recorded track to the launch that explains it: position, velocity, spin, drag and lift factor.

Least squares through the project's own flight and bounce, with a robust loss, each sample weighted by its noise.
Priors determine what the samples don't, and the covariance shows it:

* The spin along the velocity makes no lift. It shows only a little as the velocity turns; its prior does the rest.
* Only the product of lift factor and spin rate acts on a flight, and fast spin changes the lift little. So many rates
  explain a flight equally well: ``spin_posterior`` finds all of them, and the result is the launch in their middle. A
  bounce gives information about the spin again, if the ball rolls as it leaves.
* Priors keep drag and lift factor near 1, and restitution and friction of the table near the nominal ones, where
  the fit goes through a bounce.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from common.physics.constants import AIR_FACTOR, BALL_RADIUS, GRAVITY
from common.physics.flight import SIMPLE_DRAG, SIMPLE_LIFT_MAX, SIMPLE_LIFT_SLOPE
from common.task.launch import DRAG_FACTOR, LIFT_FACTOR, POSITION, SPIN, VELOCITY
from topspin.real2sim.fit.bounces import Bounce, Touches, touches
from topspin.real2sim.fit.fit_problem import (
    FLOWN,
    FRICTION,
    NO_TABLE,
    RESTITUTION0,
    UNKNOWNS,
    Air,
    FitOptions,
    Problem,
)
from topspin.real2sim.fit.predict import predict
from topspin.real2sim.fit.spin_posterior import spin_posterior
from topspin.real2sim.formats.tracks import FEWEST_SAMPLES, Array, RecordingError, Track

SPIN_STARTS: Final = (
    1.0,
    2.5,
    5.0,
)  # times the spin before the bounce: starts of the search through the bounce
THINNED: Final = 0.005  # s; samples of a fast camera are averaged over so long: the path bends by 10 um
PRIOR_SAMPLES: Final = 10.0  # as so many samples the noise in the options counts
_MAD: Final = 1.4826  # median of |x| to sigma, normal distribution


@dataclass(frozen=True, slots=True)
class Fit:
    """A launch that explains a track.

    Attributes:
        id: The track's.
        launch: (11,) position [m], velocity [m/s], spin [rad/s], drag and lift factor at the track's first sample.
        table: (2,) the table's restitution e_0 and friction mu: the priors' means if the fit has no bounce.
        covariance: (13, 13) of launch and table; zero for values that were not free.
        spin_interval: (2, 3) [rad/s] 95 % interval of each component of the spin.
        rms: Of the 3-D distance between samples and fit [m].
        used_samples: Number of samples in the fit.
        samples: Number of samples in the track.
        bounced: The fit goes through a bounce, or through both bounces of a serve.
        is_serve: The ball bounced on the server's own court first.
        noise: Sigma of a sample's position [m] and of its time stamp [s], as the residuals show them; well above those
            in ``FitOptions``: the model doesn't explain the track. The covariance contains them.
        options: What was fitted.
    """

    id: str
    launch: Array
    table: Array
    covariance: Array
    spin_interval: Array
    rms: float
    used_samples: int
    samples: int
    bounced: bool
    is_serve: bool
    noise: tuple[float, float]
    options: FitOptions

    @property
    def position(self) -> Array:
        """Return the position (3,) [m] at the first sample."""
        return self.launch[POSITION]

    @property
    def velocity(self) -> Array:
        """Return the velocity (3,) [m/s] at the first sample."""
        return self.launch[VELOCITY]

    @property
    def spin(self) -> Array:
        """Return the spin (3,) [rad/s]."""
        return self.launch[SPIN]

    @property
    def drag_factor(self) -> float:
        """Return the drag factor [-]."""
        return float(self.launch[DRAG_FACTOR])

    @property
    def lift_factor(self) -> float:
        """Return the lift factor [-]."""
        return float(self.launch[LIFT_FACTOR])

    @property
    def sigmas(self) -> Array:
        """Return the standard deviations (13,) of launch and table."""
        return np.sqrt(np.diag(self.covariance))


def _first_guess(track: Track, options: FitOptions) -> Array:
    """Return values (13,) near the flight: a polynomial's state, and the spin that explains its curvature."""
    t, p = track.times, track.positions
    middle = t[len(t) // 2]
    span = t[-1] - middle
    series = np.polynomial.polynomial.polyfit((t - middle) / span, p, 3 if len(t) > 24 else 2)
    vel, acceleration = series[1] / span, 2.0 * series[2] / span**2
    at_start = np.array(
        [np.polynomial.polynomial.polyval(-middle / span, series[:, axis]) for axis in range(3)]
    )
    air = options.air
    launch = np.zeros(UNKNOWNS)
    launch[RESTITUTION0], launch[FRICTION] = options.restitution0, options.friction
    launch[POSITION] = at_start
    launch[VELOCITY] = vel - middle * acceleration
    launch[DRAG_FACTOR] = 0.0 if air is Air.NONE else 1.0
    launch[LIFT_FACTOR] = 1.0 if air is Air.ALL else 0.0
    if air is Air.ALL:
        speed = float(np.linalg.norm(vel))
        lift = acceleration + AIR_FACTOR * SIMPLE_DRAG * speed * vel + np.array([0.0, 0.0, GRAVITY])
        spin = np.cross(vel, lift) / (AIR_FACTOR * SIMPLE_LIFT_SLOPE * BALL_RADIUS * speed**3)
        most = 0.9 * SIMPLE_LIFT_MAX / SIMPLE_LIFT_SLOPE * speed / BALL_RADIUS
        launch[SPIN] = spin * min(1.0, most / max(float(np.linalg.norm(spin)), 1e-9))
    return launch


def _part(track: Track, end: int, bounces: Sequence[Bounce] = ()) -> Track:
    """Return the first samples of a track. Those of a fast camera are averaged over ``THINNED``, between bounces."""
    times, positions = track.times[:end], track.positions[:end]
    many = int(THINNED / float(np.median(np.diff(times)))) if end > 1 else 1
    if many < 2:
        return replace(track, times=times, positions=positions)
    cuts = [0, *(bounce.first_after for bounce in bounces if bounce.first_after < end), end]
    parts = [
        rows
        for first, last in pairwise(cuts)
        for rows in np.array_split(np.arange(first, last), max(1, (last - first) // many))
        if len(rows)
    ]
    return replace(
        track,
        times=np.array([times[rows].mean() for rows in parts]),
        positions=np.array([positions[rows].mean(axis=0) for rows in parts]),
    )


def _noise(problem: Problem, unknowns: Array) -> tuple[float, float]:
    """Return the noise that the residuals show: sigma of a position [m] and of a time stamp [s].

    The noise in the options counts as ``PRIOR_SAMPLES`` samples. Across the flight, time stamps have no effect.
    """
    problem.residuals(unknowns)
    speed = np.linalg.norm(problem.velocities, axis=1)
    along = problem.velocities / np.maximum(speed, 1e-9)[:, None]
    off = problem.track.positions - problem.predicted
    lengthwise = np.sum(off * along, axis=1)
    across = np.linalg.norm(off - lengthwise[:, None] * along, axis=1)
    n = len(across)
    free = n / max(n - len(unknowns) / 3.0, 0.5 * n)  # what the unknowns took

    def pooled(shown: float, assumed: float) -> float:
        return (n * free * shown + PRIOR_SAMPLES * assumed) / (n + PRIOR_SAMPLES)

    # the median of the distance in two directions is 1.1774 sigma
    position = pooled((float(np.median(across)) / 1.1774) ** 2, problem.options.position_sigma**2)
    typical = float(np.median(speed))
    assumed = position + (problem.options.timing_sigma * typical) ** 2
    total = pooled((_MAD * float(np.median(np.abs(lengthwise)))) ** 2, assumed)
    return float(np.sqrt(position)), float(np.sqrt(max(total - position, 0.0)) / max(typical, 1e-9))


def _solved(track: Track, found: Touches, options: FitOptions) -> tuple[Problem, Any]:
    """Return the least squares of a track, through its bounces if the options say so, and their solution."""
    before = found.bounces[0].first_after if found.bounces else found.end
    if before < FEWEST_SAMPLES:
        raise RecordingError(
            f"recording {track.id}: got {before} samples before the ball touches anything; "
            f"allowed: {FEWEST_SAMPLES} or more"
        )
    flight = _part(track, before)
    first = _first_guess(flight, options)
    problem = Problem(flight, options, False, first)
    best = problem.solve(first)
    if found.bounces and options.through_bounce:
        values = problem.values(best.x)
        problem = Problem(_part(track, found.flight_end, found.bounces), options, True, first)
        starts = [values.copy() for _ in (SPIN_STARTS if options.air is Air.ALL else SPIN_STARTS[:1])]
        for start, factor in zip(starts, SPIN_STARTS, strict=False):
            start[SPIN] *= factor
        best = min((problem.solve(start) for start in starts), key=lambda result: float(result.cost))
    # with too small a noise, the priors would have too little weight
    noise = _noise(problem, best.x)
    weighted = Problem(problem.track, options, problem.bounces, first, noise)
    return weighted, weighted.solve(problem.values(best.x))


def fit(track: Track, options: FitOptions | None = None) -> Fit:
    """Return the launch that explains a track best.

    Samples after a stroke or after a second bounce on the robot's court are left out.

    Raises:
        RecordingError: Too few samples before the first bounce or stroke.
    """
    options = options or FitOptions()
    found = touches(track)
    problem, best = _solved(track, found, options)
    if options.air is not Air.ALL:
        values, covariance = problem.values(best.x), problem.covariance(best.x)
        interval = np.stack([values[SPIN], values[SPIN]])
    else:
        moments = np.array([bounce.time for bounce in found.bounces] if problem.bounces else [])
        shown = spin_posterior(problem, best.x, moments)
        values, covariance, interval = shown.values, shown.covariance, shown.spin_interval
    end = (
        found.flight_end
        if problem.bounces
        else (found.bounces[0].first_after if found.bounces else found.end)
    )
    predicted = np.empty((end, 3))
    table = values[RESTITUTION0:] if problem.bounces else NO_TABLE
    predict(values[:FLOWN], table, options.flight, track.times[:end], predicted, np.empty((end, 3)))
    distances = np.linalg.norm(predicted - track.positions[:end], axis=1)
    return Fit(
        id=track.id,
        launch=values[:FLOWN],
        table=values[RESTITUTION0:],
        covariance=covariance,
        spin_interval=interval,
        rms=float(np.sqrt(np.mean(distances**2))),
        used_samples=end,
        samples=len(track.times),
        bounced=problem.bounces,
        is_serve=problem.bounces and found.is_serve,
        noise=problem.noise,
        options=options,
    )
