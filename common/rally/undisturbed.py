"""Where a rally's ball would go if nobody played it: how hard a ball is, told apart from how it was played."""

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import GRID_STEP, TABLE_HALF_LENGTH
from common.physics.flight import flight_step
from common.physics.fly import NO_ROBOT, fly_step, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, ROBOT_COURT
from common.physics.vec import Vec
from common.rally.launch import LONGEST_FLIGHT

Array = npt.NDArray[np.float64]

ARRIVAL_X = -TABLE_HALF_LENGTH  # [m] the vertical plane of the table's end on the robot's side
_HALVINGS = 50  # of a grid step: finer than a float64's time


@kernel
def _crossing(pos: Vec, vel: Vec, spin: Vec, flown: float, drag: float, lift: float, model: int) -> Vec:
    """Return where the ball crosses the arrival plane within the next ``flown`` seconds; it does."""
    low, high = 0.0, flown
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        there, _ = flight_step(pos, vel, spin, middle, drag, lift, model)
        if there[0] > ARRIVAL_X:
            low = middle
        else:
            high = middle
    there, _ = flight_step(pos, vel, spin, high, drag, lift, model)
    return there


@kernel
def _fly(launch: Array, condition: Array, model: int, no_robot: Array, bounce: Array, arrival: Array) -> None:
    """Write bounce and arrival of one ball, nan where there is none."""
    drag, lift = condition[0], condition[1]
    pos, vel = (launch[0], launch[1], launch[2]), (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    for k in range(3):
        bounce[k], arrival[k] = np.nan, np.nan
    pos, vel, _, what, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, drag, lift, model, no_robot)
    if what != ROBOT_COURT:
        return
    for k in range(3):
        bounce[k] = pos[k]
    vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
    for _ in range(int(LONGEST_FLIGHT / GRID_STEP)):
        before, before_vel = pos, vel
        pos, vel, flown, what, _ = fly_step(
            pos, vel, spin, GRID_STEP, drag, lift, model, no_robot, 0.0, 1.0, 0.0
        )
        if pos[0] <= ARRIVAL_X:
            there = _crossing(before, before_vel, spin, flown, drag, lift, model)
            for k in range(3):
                arrival[k] = there[k]
            return
        if what != NONE:
            return


@kernel
def _fly_all(
    launches: Array, conditions: Array, model: int, no_robot: Array, bounces: Array, arrivals: Array
) -> None:
    for k in range(launches.shape[0]):
        _fly(launches[k], conditions[k], model, no_robot, bounces[k], arrivals[k])


def undisturbed(launches: Array, conditions: Array, model: int) -> tuple[Array, Array]:
    """Return where balls bounce on the robot's court (n, 3) [m], and where they then cross the table's end (n, 3) [m].

    A ball that touches anything before the robot's court has neither, nan; one that bounces twice, or drops beside the
    table, has no arrival.

    Args:
        launches: As ``launch.RallyBlock.launches`` (n, 11).
        conditions: ``noise.Condition`` of the same rallies (n, 14): air and table count.
        model: ``flight.SIMPLE`` or ``flight.FULL``.
    """
    bounces, arrivals = np.empty((len(launches), 3)), np.empty((len(launches), 3))
    _fly_all(launches, conditions, model, NO_ROBOT, bounces, arrivals)
    return bounces, arrivals
