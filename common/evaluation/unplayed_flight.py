"""The flight of a rally's ball without a robot: it shows how difficult a ball is, apart from how it was played."""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.constants import GRID_STEP, TABLE_HALF_LENGTH
from common.physics.flight import Air, flight_step
from common.physics.flight_model import Flight
from common.physics.fly import NO_ROBOT, RobotPath, fly_step, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.physics.touch import NONE, OPPONENT_COURT, ROBOT_COURT
from common.physics.vec import Vec
from common.task.launch import KIND, LONGEST_FLIGHT
from common.task.launch_presets import SERVE
from common.task.randomization import RallyParameter, air_of

Array = npt.NDArray[np.float64]

ARRIVAL_X: Final = -TABLE_HALF_LENGTH  # [m] the vertical plane of the table's end on the robot's side
_HALVINGS: Final = 50  # of a grid step: finer than a float64's time


@kernel
def _crossing(pos: Vec, vel: Vec, spin: Vec, flown: float, air: Air) -> Vec:
    """Return where the ball crosses the arrival plane within ``flown`` seconds. The caller knows that it does."""
    low, high = 0.0, flown
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        there, _ = flight_step(pos, vel, spin, middle, air)
        if there[0] > ARRIVAL_X:
            low = middle
        else:
            high = middle
    there, _ = flight_step(pos, vel, spin, high, air)
    return there


@kernel
def _fly(
    launch: Array, parameters: Array, model: int, no_robot: RobotPath, bounce: Array, arrival: Array
) -> None:
    """Write bounce and arrival of one ball; nan where there is none."""
    air = air_of(parameters, model)
    pos, vel = (launch[0], launch[1], launch[2]), (launch[3], launch[4], launch[5])
    spin = (launch[6], launch[7], launch[8])
    for k in range(3):
        bounce[k], arrival[k] = np.nan, np.nan
    restitution, friction = (
        parameters[RallyParameter.TABLE_RESTITUTION0],
        parameters[RallyParameter.TABLE_FRICTION],
    )
    pos, vel, _, what, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, no_robot)
    if launch[KIND] == SERVE and what == OPPONENT_COURT:
        vel, spin = table_bounce(vel, spin, normal, restitution, friction)
        pos, vel, _, what, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, no_robot)
    if what != ROBOT_COURT:
        return
    for k in range(3):
        bounce[k] = pos[k]
    vel, spin = table_bounce(vel, spin, normal, restitution, friction)
    for _ in range(int(LONGEST_FLIGHT / GRID_STEP)):
        before, before_vel = pos, vel
        pos, vel, flown, what, _ = fly_step(pos, vel, spin, GRID_STEP, air, no_robot, 0.0)
        if pos[0] <= ARRIVAL_X:
            there = _crossing(before, before_vel, spin, flown, air)
            for k in range(3):
                arrival[k] = there[k]
            return
        if what != NONE:
            return


@kernel
def _fly_all(
    launches: Array, parameters: Array, model: int, no_robot: RobotPath, bounces: Array, arrivals: Array
) -> None:
    for k in range(launches.shape[0]):
        _fly(launches[k], parameters[k], model, no_robot, bounces[k], arrivals[k])


def unplayed_flight(launches: Array, parameters: Array, flight: Flight) -> tuple[Array, Array]:
    """Return where balls bounce on the robot's court (n, 3) [m], and where they then cross the table's end (n, 3) [m].

    A ball that touches anything before the robot's court, but for a serve's bounce, has neither (nan). A ball that
    bounces twice, or drops beside the table, has no arrival (nan).

    Args:
        launches: As ``launch.RallyBlock.launches`` (n, 12).
        parameters: ``randomization.RallyParameter`` of the same rallies (n, 16), for air and table.
        flight: Model of the aerodynamics.
    """
    bounces, arrivals = np.empty((len(launches), 3)), np.empty((len(launches), 3))
    _fly_all(launches, parameters, int(flight), NO_ROBOT, bounces, arrivals)
    return bounces, arrivals
