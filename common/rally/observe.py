"""The observation of policy and critic, written by one kernel."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.perception.flight_track import PREDICTED, PRESENT, SERVED, SPIN
from common.physics.chain import Chain, quaternion_of, racket_state
from common.physics.constants import GRID_STEP
from common.rally.state import STAMP, Array, Integers, Rallies
from common.task.observation import ObservationConfig
from common.task.randomization import RallyParameter

_SPINS: Final = ("hidden", "estimated", "true")
_SPIN_HIDDEN, _SPIN_TRUE = _SPINS.index("hidden"), _SPINS.index("true")
# First columns of RallyParameter, drag to racket spin loss, that the critic observes
_AIR_TABLE_RUBBER: Final = 8


class ObservationFlags(NamedTuple):
    """``ObservationConfig`` for kernels."""

    is_filtered: bool  # the ball of the paper's 37 numbers is the flight filter's, not the newest measurement
    spin: int  # index into ``_SPINS``
    is_predicted: bool  # the present ball and its interception follow
    has_age: bool  # the age of the newest measurement follows
    is_privileged: bool  # the simulator's truth follows, for the critic


def observation_flags(options: ObservationConfig) -> ObservationFlags:
    """Return the options in the kernels' form."""
    return ObservationFlags(
        is_filtered=options.ball == "filtered",
        spin=_SPINS.index(options.spin),
        is_predicted=options.prediction,
        has_age=options.age,
        is_privileged=options.critic == "privileged",
    )


@kernel
def observe(
    rallies: Rallies,
    rows: Integers,
    joint_pos: Array,
    joint_vel: Array,
    chain: Chain,
    flags: ObservationFlags,
    out: npt.NDArray[np.float32],
) -> None:
    """Write ``observation.critic_layout`` of ``rows`` (n,) into the same rows of ``out`` (B, D).

    Args:
        rallies: The rallies.
        rows: Rows to read and write.
        joint_pos: Joint positions now (B, 7) [m, rad].
        joint_vel: Joint velocities now (B, 7) [m/s, rad/s].
        chain: Of the robot.
        flags: Which parts the layout has.
        out: The observations.
    """
    for k in range(rows.shape[0]):
        b = rows[k]
        o, q, qd = out[b], joint_pos[b], joint_vel[b]
        joints = (q[0], q[1], q[2], q[3], q[4], q[5], q[6])
        rates = (qd[0], qd[1], qd[2], qd[3], qd[4], qd[5], qd[6])
        pose, velocity, _ = racket_state(chain, joints, rates)
        centre, quaternion = pose.centre, quaternion_of(pose)
        for j in range(7):
            o[j], o[7 + j] = q[j], qd[j]
        for j in range(3):
            o[14 + j], o[21 + j] = centre[j], velocity[j]
        for j in range(4):
            o[17 + j] = quaternion[j]
        for j in range(6):
            o[24 + j] = rallies.track[b, PRESENT + j] if flags.is_filtered else rallies.measurement[b, j]
        o[30] = rallies.parameters[b, RallyParameter.TARGET_X]
        o[31] = rallies.parameters[b, RallyParameter.TARGET_Y]
        s = int(rallies.measurement[b, 6])
        o[32] = 2.0 * s / 3.0 - 1.0 if s != SERVED else -1.0
        for j in range(4):
            o[33 + j] = 1.0 if j == s else 0.0  # all 0: a serve before its first bounce
        at = 37
        if flags.spin != _SPIN_HIDDEN:
            for j in range(3):
                o[at + j] = rallies.ball[b, 6 + j] if flags.spin == _SPIN_TRUE else rallies.track[b, SPIN + j]
            at += 3
        if flags.is_predicted:
            for j in range(PREDICTED):
                o[at + j] = rallies.track[b, PRESENT + j]
            at += PREDICTED
        if flags.has_age:
            o[at] = rallies.clock[b] * GRID_STEP - rallies.measurement[b, STAMP]
            at += 1
        for past in range(rallies.measurement_history.shape[1]):
            for j in range(6):
                o[at + j] = rallies.measurement_history[b, past, j]
            at += 6
        if flags.is_privileged:
            for j in range(9):
                o[at + j] = rallies.ball[b, j]
            for j in range(_AIR_TABLE_RUBBER):
                o[at + 9 + j] = rallies.parameters[b, j]
