"""Random contacts for the property tests, and the mechanics that they are compared with (written again in numpy)."""

import math
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from common.physics.vec import Vec

BALL_MASS, BALL_RADIUS = 0.0027, 0.020  # kg, m
BALL_INERTIA = 7.2e-7  # kg m^2: a thin shell, 2/3 m r^2


class Contact(NamedTuple):
    """A ball about to touch a surface: velocities in the table frame."""

    vel: Vec
    spin: Vec
    normal: Vec
    surface_vel: Vec


def vectors(limit: float) -> st.SearchStrategy[Vec]:
    component = st.floats(-limit, limit, allow_subnormal=False)
    return st.tuples(component, component, component)


@st.composite
def directions(draw: st.DrawFn) -> Vec:
    z = draw(st.floats(-1.0, 1.0, allow_subnormal=False))
    azimuth = draw(st.floats(-math.pi, math.pi, allow_subnormal=False))
    across = math.sqrt(1.0 - z * z)
    return (across * math.cos(azimuth), across * math.sin(azimuth), z)


@st.composite
def contacts(draw: st.DrawFn, moving: bool = True, spin_limit: float = 600.0) -> Contact:
    """Draw a surface at any angle, at rest or moving, and a ball that approaches it at 0.1 to 20 m/s."""
    normal = np.array(draw(directions()))
    surface_vel = np.array(draw(vectors(10.0))) if moving else np.zeros(3)
    drift = np.array(draw(vectors(15.0)))
    approach = draw(st.floats(0.1, 20.0))
    u = drift - (drift @ normal) * normal - approach * normal
    return Contact(as_vec(u + surface_vel), draw(vectors(spin_limit)), as_vec(normal), as_vec(surface_vel))


def as_vec(a: np.ndarray) -> Vec:
    return (float(a[0]), float(a[1]), float(a[2]))


def mirrored(a: Vec) -> Vec:
    """Return the image of a position or velocity in the plane y = 0."""
    return (a[0], -a[1], a[2])


def mirrored_spin(a: Vec) -> Vec:
    """Return the image of a spin: the component of a pseudo-vector across the mirror stays."""
    return (-a[0], a[1], -a[2])


def slip_of(vel: Vec, spin: Vec, contact: Contact) -> np.ndarray:
    """Return the velocity of the ball's point at the contact against the surface, normal part removed."""
    n = np.array(contact.normal)
    point = np.array(vel) + np.cross(spin, -BALL_RADIUS * n) - contact.surface_vel
    return np.asarray(point - (point @ n) * n)


def kinetic_energy(vel: Vec, spin: Vec, frame_vel: Vec = (0.0, 0.0, 0.0)) -> float:
    """Return the energy of the ball in the frame that moves with ``frame_vel`` [J]."""
    u = np.subtract(vel, frame_vel)
    return float(0.5 * BALL_MASS * (u @ u) + 0.5 * BALL_INERTIA * np.dot(spin, spin))
