"""Flight to the first touch, compared with a slow reference. They share no constant.

The reference integrates all balls at once with DOP853 to 1e-10, without any contact. It searches the dense solution in
steps of 0.25 ms until the ball's surface is inside table, net or floor, and bisects that step along its chord. The
error of the chord is less than 1 um.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from common.physics import touch
from common.physics.flight import SIMPLE, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from tests.unit.physics.contacts import as_vec, mirrored, mirrored_spin

Array = npt.NDArray[np.float64]

BALLS = 1600  # more than 1,000 of them touch something before they are out of play
DURATION = 1.2  # s: the longest flight of these launches
SAMPLE = 2.5e-4  # s


class Launches(NamedTuple):
    pos: Array
    vel: Array
    spin: Array
    drag: Array
    lift: Array


def make_launches(n: int = BALLS, seed: int = 0) -> Launches:
    """Return launches from weak to very strong: |v| to 20 m/s, |w| to 600 rad/s, from above either court."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3)) * [1.0, 0.4, 0.2] - [0.0, 0.0, 0.2]
    speed = rng.uniform(2.0, 20.0, (n, 1))
    side, one = rng.choice([-1.0, 1.0], n), np.ones(n)
    return Launches(
        pos=rng.uniform([0.05, -0.7, 0.05], [1.3, 0.7, 0.8], (n, 3)) * np.column_stack([side, one, one]),
        vel=speed * direction / np.linalg.norm(direction, axis=1, keepdims=True),
        spin=rng.uniform(-350.0, 350.0, (n, 3)),
        drag=rng.uniform(0.7, 1.3, n),
        lift=rng.uniform(0.6, 1.4, n),
    )


def derivative(state: Array, launches: Launches) -> Array:
    """Return d(pos, vel)/dt of all balls: -g z - k C_D |v| v + k C_L |v|^2 (w^ x v^), as it is written."""
    vel = state[:, 3:]
    speed = np.linalg.norm(vel, axis=1, keepdims=True)
    spin_rate = np.linalg.norm(launches.spin, axis=1, keepdims=True)
    k = 1.204 * np.pi * 0.02**2 / (2 * 0.0027)
    C_D = 0.55 * launches.drag[:, None]
    C_L = np.minimum(1.067 * 0.02 * spin_rate / speed, 0.267) * launches.lift[:, None]
    lift_direction = np.cross(launches.spin / spin_rate, vel / speed)
    acceleration = -k * C_D * speed * vel + k * C_L * speed**2 * lift_direction - [0.0, 0.0, 9.81]
    return np.hstack([vel, acceleration])


def box_distance(pos: Array, centre: tuple[float, ...], half: tuple[float, ...]) -> Array:
    """Return the distance of points from a box."""
    return np.asarray(np.linalg.norm(np.maximum(np.abs(pos - centre) - half, 0.0), axis=-1))


def gaps(pos: Array) -> Array:
    """Return the distance of the ball's surface from table, net and floor, (..., 3)."""
    table = box_distance(pos, (0.0, 0.0, -0.0125), (1.37, 0.7625, 0.0125))
    net = box_distance(pos, (0.0, 0.0, 0.07625), (0.003, 0.915, 0.07625))
    return np.stack([table, net, pos[..., 2] + 0.76], axis=-1) - 0.02


def reference_touches(launches: Launches) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Return time, position and obstacle (0 table, 1 net, 2 floor) of each ball's first touch; NaN: none."""
    n = len(launches.drag)
    flight = solve_ivp(
        lambda _, y: derivative(y.reshape(n, 6), launches).ravel(),
        (0.0, DURATION),
        np.hstack([launches.pos, launches.vel]).ravel(),
        method="DOP853",
        rtol=1e-10,
        atol=1e-10,
        dense_output=True,
    ).sol
    moment, before, after = np.full(n, np.nan), np.empty((n, 3)), np.empty((n, 3))
    last, out = launches.pos, np.full(n, False)
    for sample in range(1, round(DURATION / SAMPLE)):
        t = sample * SAMPLE
        pos = flight(t).reshape(n, 6)[:, :3]
        new = np.isnan(moment) & ~out & (gaps(pos).min(axis=1) < 0.0)
        moment[new], before[new], after[new] = t - SAMPLE, last[new], pos[new]
        last = pos
        if sample % round(0.005 / SAMPLE) == 0:  # whether a ball is out of play is checked on the grid
            out |= (np.abs(pos[:, 0]) > 3.6) | (np.abs(pos[:, 1]) > 2.3)
    assert np.all(out | ~np.isnan(moment))
    low, high = np.zeros((n, 1)), np.ones((n, 1))
    for _ in range(40):
        middle = (low + high) / 2
        inside = gaps(before + middle * (after - before)).min(axis=1, keepdims=True) < 0.0
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    touched = before + high * (after - before)
    return moment + high[:, 0] * SAMPLE, touched, gaps(touched).argmin(axis=1)


def fly(launches: Launches, ball: int):
    pos, vel, spin = (as_vec(a[ball]) for a in launches[:3])
    drag, lift = float(launches.drag[ball]), float(launches.lift[ball])
    return fly_to_touch(pos, vel, spin, 2.0, Air(drag, lift, SIMPLE), NO_ROBOT)


def test_the_first_touch_of_spinning_balls_is_exact_to_a_tenth_of_a_millimetre_and_a_millisecond():
    launches = make_launches()
    moment, pos, obstacle = reference_touches(launches)
    flown = [fly(launches, ball) for ball in range(BALLS)]
    obstacles = {
        touch.ROBOT_COURT: 0,
        touch.OPPONENT_COURT: 0,
        touch.EDGE: 0,
        touch.NET: 1,
        touch.FLOOR: 2,
    }
    touching = ~np.isnan(moment)

    assert all(flown[ball][3] == touch.OUT for ball in range(BALLS) if not touching[ball])
    assert touching.sum() >= 1000
    assert np.bincount(obstacle[touching]).min() >= 50
    for ball in np.flatnonzero(touching):
        p, _, t, what, _ = flown[ball]

        assert obstacles[what] == obstacle[ball]
        assert abs(t - moment[ball]) < 1e-4
        assert np.linalg.norm(p - pos[ball]) < 1e-4


def test_whole_flights_are_mirror_symmetric():
    launches = make_launches(200, seed=1)
    for ball in range(200):
        pos, vel, spin = (as_vec(a[ball]) for a in launches[:3])
        drag, lift = float(launches.drag[ball]), float(launches.lift[ball])
        p, v, t, what, normal = fly(launches, ball)
        image = fly_to_touch(
            mirrored(pos), mirrored(vel), mirrored_spin(spin), 2.0, Air(drag, lift, SIMPLE), NO_ROBOT
        )

        assert image == (mirrored(p), mirrored(v), t, what, mirrored(normal))
