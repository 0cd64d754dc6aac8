"""Hits for the tests of the hit correction, and slow references of their results."""

import numpy as np

from common.physics.chain import point_velocity, racket_motion, racket_pose
from common.physics.constants import Rubber
from common.physics.flight import SIMPLE, Air, flight_step
from common.physics.racket_bounce import racket_bounce
from common.physics.touch import racket_gap
from common.rally.hit_correction import (
    BACK,
    BALL_POS,
    BALL_SPIN,
    BALL_VEL,
    BOUNCE,
    CONTACT,
    FRESH,
    HIT,
    JOINT_POS,
    JOINT_VEL,
    MOMENT,
    STEP,
    DriveHistory,
    hit_result,
    write_departure,
)
from common.robot.chain_of import chain_of
from common.task.randomization import PROFILES, RALLY_PARAMETERS, air_of, draw_parameters, rubber_of
from tests.unit.rally.scripted import HOME

CHAIN = chain_of("rails")

SUBSTEPS, H = 5, 0.004
BALL_RADIUS, NET_HEIGHT = 0.020, 0.1525  # m
# inertia, k_p, k_v, half-range, slope of force and speed at the voltage limit: similar to the robot's
DRIVES = np.array(
    [
        [12.0, 10.0, 0.5, 0.4, 0.2, 0.02, 0.001],
        [8000.0, 5000.0, 200.0, 500.0, 200.0, 80.0, 40.0],
        [600.0, 400.0, 8.0, 20.0, 8.0, 3.0, 1.5],
        [0.5, 0.9, 2.9, 1.7, 2.4, 2.1, 2.9],
        [800.0, 600.0, 10.0, 10.0, 5.0, 2.6, 1.3],
    ]
)


FRICTION = np.array([60.0, 90.0, 1.6, 1.6, 0.8, 0.4, 0.2])


def make_parameters(seed=0) -> np.ndarray:
    parameters = np.empty(RALLY_PARAMETERS)
    draw_parameters(np.uint64(seed), 1.0, 1.0, 0.0, PROFILES["standard"], parameters)
    return parameters


def make_hit(seed=0, step=30, off=0.0) -> np.ndarray:
    """Return a hit (HIT,) towards the opponent's court, with the ball ``off`` [m] from the racket."""
    rng = np.random.default_rng(seed)
    q = np.array(HOME) + 0.05 * rng.uniform(-1, 1, 7)
    q[5] -= 0.15  # the face points up a little
    rates = np.array([1.5, 0.2, 0.3, 1.0, 1.0, 2.0, 0.5]) * rng.uniform(0.5, 1.0, 7)
    pose = racket_pose(CHAIN, tuple(q))
    place = 0.03 * rng.uniform(-1, 1, 2)
    hit = np.zeros(HIT)
    hit[BALL_POS : BALL_POS + 3] = (
        np.array(pose.centre)
        + (0.0065 + BALL_RADIUS + off) * np.array(pose.normal)
        + place[0] * np.array(pose.side)
        + place[1] * np.array(pose.up)
    )
    hit[BALL_VEL : BALL_VEL + 3] = rng.uniform([-4, -0.5, -1], [-2.5, 0.5, 1])
    hit[BALL_SPIN : BALL_SPIN + 3] = rng.uniform(-60, 60, 3)
    hit[JOINT_POS : JOINT_POS + 7], hit[JOINT_VEL : JOINT_VEL + 7] = q, rates
    hit[MOMENT], hit[STEP], hit[FRESH] = 0.0133, step, 1.0
    hit[BOUNCE], hit[CONTACT] = 0.2, 0.4
    leave(hit, make_parameters(seed))
    return hit


def leave(hit, parameters) -> None:
    """Write the ball that leaves the racket by our contact law."""
    pos, vel, spin, _, _ = bounced(hit, parameters)
    write_departure(hit, pos, vel, spin)


def result_of(hit, parameters) -> np.ndarray:
    parts = [tuple(hit[a:b]) for a, b in ((9, 16), (16, 23), (0, 3), (3, 6), (6, 9))]
    return np.array(hit_result(CHAIN, *parts, rubber_of(parameters), air_of(parameters, SIMPLE)))


def bounced(hit, parameters) -> tuple:
    """Return the ball that leaves, its place on the racket (2) and the contact's delay, by a slow reference."""
    q, qd = hit[JOINT_POS : JOINT_POS + 7].copy(), tuple(hit[JOINT_VEL : JOINT_VEL + 7])
    pos, vel, spin = (hit[k : k + 3].copy() for k in (BALL_POS, BALL_VEL, BALL_SPIN))
    # Both move uniformly until they meet: bisection in time
    low, high = -0.003, 0.003
    for _ in range(60):
        middle = 0.5 * (low + high)
        gap, _ = racket_gap(tuple(pos + middle * vel), racket_pose(CHAIN, tuple(q + middle * np.array(qd))))
        low, high = (middle, high) if gap > 0 else (low, middle)
    q, pos = q + low * np.array(qd), pos + low * vel
    pose = racket_pose(CHAIN, tuple(q))
    _, normal = racket_gap(tuple(pos), pose)
    racket_vel, racket_spin = racket_motion(CHAIN, tuple(q), qd)
    surface_vel = point_velocity(
        pose.centre, racket_vel, racket_spin, tuple(pos - BALL_RADIUS * np.array(normal))
    )
    place = [np.dot(pos - pose.centre, axis) for axis in (pose.side, pose.up)]
    v, w = racket_bounce(tuple(vel), tuple(spin), normal, surface_vel, Rubber(*parameters[4:8], np.inf))
    return tuple(pos), v, w, place, low


def flown(hit, parameters) -> np.ndarray:
    """Return landing x, y, place on the racket (2), height over the net and delay of a hit, by a slow reference."""
    p, v, w, place, later = bounced(hit, parameters)
    landing, over, is_down = (np.nan, np.nan), -1.0, False
    for _ in range(6000):
        before = p
        p, v = flight_step(p, v, w, 0.0005, Air(parameters[0], parameters[1], SIMPLE))
        if before[0] < 0 <= p[0]:
            over = p[2] - NET_HEIGHT - BALL_RADIUS
        if not is_down and p[2] < BALL_RADIUS and v[2] < 0:
            landing, is_down = p[:2], True
        if is_down and (p[0] > 0 or p[2] < -0.7):
            break
    return np.array([*landing, *place, over, later])


def history_of(limited=None, newest=3, steps=BACK, late=0) -> DriveHistory:
    """Return the history of drives ``DRIVES``; without ``limited`` no drive was ever at its force limit."""
    if limited is None:
        limited = np.zeros((BACK, SUBSTEPS, 7), np.int8)
    losses = np.broadcast_to(FRICTION, (BACK, SUBSTEPS, 7)).astype(np.float32)
    return DriveHistory(np.asarray(limited, np.int8), losses, newest, steps, late, DRIVES, H)
