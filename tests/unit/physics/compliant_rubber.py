"""A slow reference for the racket's law: a contact on springs and dampers, integrated in time.

The ball is a rigid shell of 2.7 g and 20 mm. Its lowest point touches a plane that moves at constant velocity. With the
depth z and the velocity c of that point along the plane the forces on the ball are

    F_n = k_n z + d_n z'     until it becomes 0, which ends the contact
    F_t = -k_t s - d_t c     with the strain s of the rubber, s' = c, 0 at first; never more than mu F_n

and m v' = F, I w' = -r n x F. Where friction limits the force the rubber slips, and the strain follows the force.

The stiffness gives a contact of about 1 ms. The dampers are calibrated on two scalar motions without slip: a linear
oscillator that separates with -e times its speed, and one along the surface, where the shell has the mass 2/5 m, that
ends with -e_t times its speed when the contact ends:

    e_t > 0: the strain comes back just then (half a period);   e_t <= 0: a damper alone, which stops the slip in part

All else follows from the integration: how velocity and spin share an impulse, its direction, friction, moving rackets.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

Array = npt.NDArray[np.float64]

MASS, RADIUS, INERTIA = 0.0027, 0.020, 7.2e-7  # kg, m, kg m^2
TANGENTIAL_MASS = 0.4 * MASS
HALF_PERIOD = 1e-3  # s: of the undamped contact along the normal
STEP = 1e-6  # s
NEVER_SLIDES = 1e9  # [-]
SLIP_STOP = 100.0  # [-] where e_t is 0 the slip decays by exp(-100) during the contact


class Springs(NamedTuple):
    """Stiffness and damping of one contact."""

    k_n: float  # N/m
    d_n: float  # N s/m
    k_t: float  # N/m
    d_t: float  # N s/m
    friction: float  # [-]
    duration: float  # s


def _separation(decay: float) -> tuple[float, float]:
    """Return duration and restitution of a damped oscillator that separates when its force is 0 (in units of omega)."""
    omega = math.sqrt(1.0 - decay * decay)
    duration = (math.pi - math.atan2(2.0 * decay * omega, omega * omega - decay * decay)) / omega
    return duration, math.exp(-decay * duration)


def springs(restitution: float, tangential: float, friction: float) -> Springs:
    """Return the contact with restitution e and tangential restitution e_t of a contact that sticks."""
    omega = math.pi / HALF_PERIOD
    decay = brentq(lambda x: _separation(x)[1] - restitution, 0.0, 0.9) if restitution < 1.0 else 0.0
    duration = _separation(decay)[0] / omega
    if tangential > 0.0:
        fading, turning = -math.log(tangential) / duration, math.pi / duration
        k_t = TANGENTIAL_MASS * (turning**2 + fading**2)
    else:
        stop = min(SLIP_STOP, -math.log(max(-tangential, 1e-99)))
        fading = stop / (2.0 * duration)
        k_t = 0.0
    return Springs(
        MASS * omega**2,
        2.0 * MASS * decay * omega,
        k_t,
        2.0 * TANGENTIAL_MASS * fading,
        min(friction, NEVER_SLIDES),
        duration,
    )


class Bounces(NamedTuple):
    """Balls after their contacts."""

    vel: Array  # (N, 3) m/s
    spin: Array  # (N, 3) rad/s
    depth: Array  # (N,) m: largest
    slipped: Array  # (N,) share of the contact in which friction limited the force


def _column(contacts: list[Springs], name: str) -> Array:
    return np.array([getattr(contact, name) for contact in contacts])[:, None]


def integrate(vel: Array, spin: Array, normal: Array, surface_vel: Array, contacts: list[Springs]) -> Bounces:
    """Return N bounces, each integrated by the midpoint rule in steps of a microsecond.

    Args:
        vel: Before (N, 3) [m/s].
        spin: Before (N, 3) [rad/s].
        normal: Of the plane, towards the ball (N, 3).
        surface_vel: Of the plane (N, 3) [m/s].
        contacts: N springs.
    """
    k_n, d_n, k_t, d_t, friction = (_column(contacts, name) for name in Springs._fields[:5])
    v, w = vel.copy(), spin.copy()
    depth, strain = np.zeros((len(v), 1)), np.zeros_like(v)
    touching = np.ones((len(v), 1), np.bool_)
    deepest, slipped, steps = np.zeros(len(v)), np.zeros(len(v)), np.zeros(len(v))

    def forces(v: Array, w: Array, depth: Array, strain: Array) -> tuple[Array, Array, Array, Array, Array]:
        point = v - surface_vel + np.cross(w, -RADIUS * normal)
        sinking = -(point * normal).sum(1, keepdims=True)
        c = point + sinking * normal
        f_n = k_n * depth + d_n * sinking
        f_t = -k_t * strain - d_t * c
        size = np.linalg.norm(f_t, axis=1, keepdims=True)
        limit = friction * np.maximum(f_n, 0.0)
        slips = size > limit
        f_t = np.where(slips, f_t * (limit / np.maximum(size, 1e-300)), f_t)
        return f_n, f_t, sinking, c, slips

    def rates(f_n: Array, f_t: Array) -> tuple[Array, Array]:
        return (f_n * normal + f_t) / MASS, np.cross(-RADIUS * normal, f_t) / INERTIA

    while touching.any():
        f_n, f_t, sinking, c, _ = forces(v, w, depth, strain)
        a, b = rates(f_n, f_t)
        half = 0.5 * STEP
        middle = v + half * a, w + half * b, depth + half * sinking, strain + half * c
        f_n, f_t, sinking, c, slips = forces(*middle)
        touching &= f_n > 0.0
        a, b = rates(f_n, f_t)
        h = STEP * touching
        v, w, depth, strain = v + h * a, w + h * b, depth + h * sinking, strain + h * c
        elastic = slips & (k_t > 0.0)
        strain = np.where(elastic, -(f_t + d_t * c) / np.maximum(k_t, 1e-300), strain)
        deepest = np.maximum(deepest, depth[:, 0])
        slipped += (slips & touching)[:, 0]
        steps += touching[:, 0]
    return Bounces(v, w, deepest, slipped / steps)
