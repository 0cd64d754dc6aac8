"""The coarse flight never contradicts the exact one, and leaves little to it."""

import numpy as np
import pytest
from numba import njit

from common.physics.flight import FULL, SIMPLE, Air, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.touch import ROBOT_COURT
from common.task.coarse_flight import INVALID, UNSURE, VALID, coarse_verdict
from common.task.launch import LONGEST_FLIGHT, launch
from common.task.launch_presets import KINDS, SERVE, Kind
from common.task.randomization import PROFILES

COUNT = 20_000


@njit(error_model="numpy")
def verdicts(balls, profile, model, count, no_robot):
    """Return the coarse verdict and the exact one of ``count`` launches."""
    coarse, exact = np.empty(count, np.int64), np.empty(count, np.bool_)
    for seed in range(count):
        pos, vel, spin, drag, lift = launch(balls, profile, seed)
        air = Air(drag, lift, model)
        coarse[seed] = coarse_verdict(pos, vel, spin, air)
        exact[seed] = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, no_robot)[3] == ROBOT_COURT
    return coarse, exact


@pytest.mark.parametrize("model", [SIMPLE, FULL])
@pytest.mark.parametrize(
    "kind", [kind for kind in range(len(KINDS)) if kind != SERVE], ids=lambda kind: Kind(kind).name
)
def test_what_the_coarse_flight_decides_the_exact_one_decides_in_the_same_way(kind, model):
    coarse, exact = verdicts(KINDS[kind], PROFILES["hard"], model, COUNT, NO_ROBOT)
    decided = coarse != UNSURE

    assert (coarse[decided] == np.where(exact[decided], VALID, INVALID)).all()
    assert decided.mean() > 0.8
    assert min((coarse == VALID).sum(), (coarse == INVALID).sum()) > 0.05 * COUNT


@njit(error_model="numpy")
def errors(balls, profile, model, count):
    """Return launch speed [m/s] and largest error [m] of steps of 30 ms, against steps of 5 ms, until table height."""
    speeds, largest = np.empty(count), np.zeros(count)
    for seed in range(count):
        pos, vel, spin, drag, lift = launch(balls, profile, seed)
        exact, exact_vel = pos, vel
        speeds[seed] = np.sqrt(vel[0] ** 2 + vel[1] ** 2 + vel[2] ** 2)
        for _ in range(40):
            pos, vel = flight_step(pos, vel, spin, 0.03, Air(drag, lift, model))
            for _ in range(6):
                exact, exact_vel = flight_step(exact, exact_vel, spin, 0.005, Air(drag, lift, model))
            for k in range(3):
                largest[seed] = max(largest[seed], abs(pos[k] - exact[k]))
            if pos[2] < 0.02:
                break
    return speeds, largest


@pytest.mark.parametrize("model", [SIMPLE, FULL])
def test_the_margins_are_five_times_the_error_of_the_steps(model):
    found = [errors(balls, PROFILES["hard"], model, COUNT) for balls in KINDS]
    speeds, largest = (np.concatenate(column) for column in zip(*found, strict=True))

    assert largest[speeds < 10.0].max() < 0.003 / 5.0
    assert largest.max() < 0.01 / 5.0


def test_few_slow_launches_are_left_to_the_exact_flight():
    coarse, _ = verdicts(KINDS[Kind.PAPER], PROFILES["standard"], FULL, COUNT, NO_ROBOT)

    assert (coarse == UNSURE).mean() < 0.06


def place(x, y, speed=6.0, up=0.0):
    """Return the coarse verdict on a ball without spin that starts 0.3 m above (x, y) and flies along -x."""
    return coarse_verdict((x, y, 0.3), (-speed, 0.0, up), (1.0, 0.0, 0.0), Air(1.0, 1.0, SIMPLE))


def test_a_ball_that_drops_on_its_own_court_is_invalid():
    assert place(1.3, 0.0, speed=1.0) == INVALID


def test_a_ball_far_into_the_net_is_invalid_and_one_near_its_cord_is_left_to_the_exact_flight():
    fates = [place(x, 0.0, speed=4.0) for x in np.linspace(0.2, 1.3, 400)]

    assert {VALID, INVALID, UNSURE} == set(fates)
    changes = [k for k in range(1, 400) if fates[k] != fates[k - 1]]
    for k in changes:  # a valid launch has no invalid neighbour
        assert UNSURE in (fates[k], fates[k - 1])


def test_a_ball_beside_the_table_is_invalid_and_one_near_its_edge_is_left_to_the_exact_flight():
    fates = [place(0.3, y, speed=5.0, up=1.0) for y in np.linspace(0.6, 0.9, 301)]
    sides = [fate for k, fate in enumerate(fates) if k == 0 or fate != fates[k - 1]]

    assert sides == [VALID, UNSURE, INVALID]


def test_a_ball_that_starts_low_or_behind_the_net_is_left_to_the_exact_flight():
    air = Air(1.0, 1.0, SIMPLE)

    assert coarse_verdict((1.0, 0.0, 0.02), (-6.0, 0.0, 3.0), (1.0, 0.0, 0.0), air) == UNSURE
    assert coarse_verdict((-0.5, 0.0, 0.3), (-2.0, 0.0, 0.0), (1.0, 0.0, 0.0), air) == UNSURE
