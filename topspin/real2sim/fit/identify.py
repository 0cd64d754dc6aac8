"""From a recorded track to the launch that explains it: position, velocity, spin, drag and lift factor.

Least squares through the project's own flight and bounce, with a robust loss, each sample weighted by its noise.
Priors determine what the samples don't, and the covariance shows it:

* The spin along the velocity makes no lift. It shows only a little as the velocity turns; its prior
  (zero, ``spin_sigma``) does the rest.
* Only the product of lift factor and spin rate acts on a flight, and above S = 0.25 the simple model's lift is
  saturated: more spin changes nothing. The result is the smallest spin that explains the lift, and towards more spin
  its sigma is the prior's. A bounce gives information about the spin again, if the ball rolls as it leaves.
* Priors keep drag and lift factor near 1, and restitution and friction of the table near the nominal ones, where
  the fit goes through a bounce.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from common.physics.constants import AIR_FACTOR, BALL_RADIUS, GRAVITY
from common.physics.flight import SIMPLE_DRAG, SIMPLE_LIFT_MAX, SIMPLE_LIFT_SLOPE
from common.task.launch import DRAG_FACTOR, LAUNCH_SIZE, LIFT_FACTOR, POSITION, SPIN, VELOCITY
from topspin.real2sim.fit.bounces import touches
from topspin.real2sim.fit.fit_problem import FRICTION, RESTITUTION0, UNKNOWNS, Air, FitOptions, Problem
from topspin.real2sim.formats.tracks import FEWEST_SAMPLES, Array, RecordingError, Track

SPIN_STARTS: Final = (
    1.0,
    2.5,
    5.0,
)  # times the spin before the bounce: starts of the search through the bounce
_MAD: Final = 1.4826  # median of |x| to sigma, normal distribution


@dataclass(frozen=True, slots=True)
class Fit:
    """A launch that explains a track.

    Attributes:
        id: The track's.
        launch: (11,) position [m], velocity [m/s], spin [rad/s], drag and lift factor at the track's first sample.
        table: (2,) the table's restitution e_0 and friction mu: the priors' means if the fit has no bounce.
        covariance: (13, 13) of launch and table; zero for values that were not free.
        rms: Of the 3-D distance between samples and fit [m].
        used_samples: Number of samples in the fit.
        bounced: The fit goes through a bounce.
        noise_scale: Residuals' robust sigma over the noise in ``FitOptions`` [-]; well above 1: the model doesn't
            explain the track. The covariance is scaled by it.
        options: What was fitted.
    """

    id: str
    launch: Array
    table: Array
    covariance: Array
    rms: float
    used_samples: int
    bounced: bool
    noise_scale: float
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


def _part(track: Track, end: int) -> Track:
    return Track(track.id, track.times[:end], track.positions[:end], track.label)


def fit(track: Track, options: FitOptions | None = None) -> Fit:
    """Return the launch that explains a track best.

    Samples after a stroke or a second bounce are left out.

    Raises:
        RecordingError: Too few samples before the first bounce or stroke.
    """
    options = options or FitOptions()
    found = touches(track)
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
        end = found.bounces[1].first_after if len(found.bounces) > 1 else found.end
        values = problem.values(best.x)
        problem = Problem(_part(track, end), options, True, first)
        starts = [values.copy() for _ in (SPIN_STARTS if options.air is Air.ALL else SPIN_STARTS[:1])]
        for start, factor in zip(starts, SPIN_STARTS, strict=False):
            start[SPIN] *= factor
        best = min((problem.solve(start) for start in starts), key=lambda result: float(result.cost))
    samples = problem.residuals(best.x)[: problem.predicted.size]
    scale = max(1.0, _MAD * float(np.median(np.abs(samples))))
    if scale > 1.0:
        # with too small a noise, the priors would have too little weight
        wider = Problem(problem.track, options, problem.bounces, first, scale)
        best, problem = wider.solve(problem.values(best.x)), wider
    covariance = problem.covariance(best.x)
    problem.residuals(best.x)
    distances = np.linalg.norm(problem.predicted - problem.track.positions, axis=1)
    values = problem.values(best.x)
    return Fit(
        track.id,
        values[:LAUNCH_SIZE],
        values[RESTITUTION0:],
        covariance,
        float(np.sqrt(np.mean(distances**2))),
        len(distances),
        problem.bounces,
        scale,
        options,
    )
