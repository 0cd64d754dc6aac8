"""The rules of a rally as one table: the state that a touch leads to, or the outcome that ends the rally.

The states follow the ball (the paper, section III-A): tau_0 launch, tau_01 on its way to the robot, tau_1 bounce on the
robot's court, tau_12 the robot catches, tau_2 racket contact, tau_23 on its way back, tau_3 landing on the opponent's
court, tau_30 the opponent catches. tau_i is an instant and lasts one control step. tau_ij continues until a touch.
A serve has two more (ours): tau_s it is served, tau_s0 on its way to the server's own court. Its bounce there is tau_0.
"""

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from common.physics.touch import Touch


class State(IntEnum):
    """Trajectory state of the ball."""

    TAU_0 = 0
    TAU_01 = 1
    TAU_1 = 2
    TAU_12 = 3
    TAU_2 = 4
    TAU_23 = 5
    TAU_3 = 6
    TAU_30 = 7
    TAU_S = 8
    TAU_S0 = 9


class Outcome(IntEnum):
    """How a rally ended."""

    NONE = 0  # the rally continues
    RETURNED = 1  # legal landing on the opponent's court
    NET = 2  # hit into the net
    OUT = 3  # hit, and the ball misses the opponent's court
    OWN_COURT = 4  # hit onto the robot's own court
    EDGE = 5  # hit onto an edge of the table
    DOUBLE_HIT = 6  # touched twice with the racket
    BODY = 7  # touched with arm, handle, column or beam
    VOLLEY = 8  # hit before it bounced
    DOUBLE_BOUNCE = 9  # bounced twice on the robot's court
    MISS = 10  # the ball passed the robot
    BAD_LAUNCH = 11  # the ball never reached the robot's court; only launches that were not validated
    TIME_OUT = 12  # the time limit ended the rally: truncation, not termination


_S, _O = State, Outcome

# fmt: off
TRANSITIONS: dict[State, dict[Touch, State | Outcome]] = {
    State.TAU_S0: {
        Touch.NONE: _S.TAU_S0, Touch.ROBOT_COURT: _O.BAD_LAUNCH, Touch.OPPONENT_COURT: _S.TAU_0,
        Touch.NET: _O.BAD_LAUNCH, Touch.RACKET: _O.VOLLEY, Touch.BODY: _O.BODY,
        Touch.EDGE: _O.BAD_LAUNCH, Touch.FLOOR: _O.BAD_LAUNCH, Touch.OUT: _O.BAD_LAUNCH,
    },
    State.TAU_01: {
        Touch.NONE: _S.TAU_01, Touch.ROBOT_COURT: _S.TAU_1, Touch.OPPONENT_COURT: _O.BAD_LAUNCH,
        Touch.NET: _O.BAD_LAUNCH, Touch.RACKET: _O.VOLLEY, Touch.BODY: _O.BODY,
        Touch.EDGE: _O.BAD_LAUNCH, Touch.FLOOR: _O.BAD_LAUNCH, Touch.OUT: _O.BAD_LAUNCH,
    },
    State.TAU_12: {
        Touch.NONE: _S.TAU_12, Touch.ROBOT_COURT: _O.DOUBLE_BOUNCE, Touch.OPPONENT_COURT: _O.MISS,
        Touch.NET: _O.MISS, Touch.RACKET: _S.TAU_2, Touch.BODY: _O.BODY,
        Touch.EDGE: _O.DOUBLE_BOUNCE, Touch.FLOOR: _O.MISS, Touch.OUT: _O.MISS,
    },
    State.TAU_23: {
        Touch.NONE: _S.TAU_23, Touch.ROBOT_COURT: _O.OWN_COURT, Touch.OPPONENT_COURT: _S.TAU_3,
        Touch.NET: _O.NET, Touch.RACKET: _O.DOUBLE_HIT, Touch.BODY: _O.BODY,
        Touch.EDGE: _O.EDGE, Touch.FLOOR: _O.OUT, Touch.OUT: _O.OUT,
    },
    State.TAU_30: {
        Touch.NONE: _S.TAU_30, Touch.ROBOT_COURT: _O.RETURNED, Touch.OPPONENT_COURT: _O.RETURNED,
        Touch.NET: _O.RETURNED, Touch.RACKET: _O.RETURNED, Touch.BODY: _O.RETURNED,
        Touch.EDGE: _O.RETURNED, Touch.FLOOR: _O.RETURNED, Touch.OUT: _O.RETURNED,
    },
}
# fmt: on
"""Each continuing state and touch. An instant tau_i has the row of its continuing state: ``CONTINUES_AS``."""

CONTINUES_AS: dict[State, State] = {
    State.TAU_0: State.TAU_01,
    State.TAU_1: State.TAU_12,
    State.TAU_2: State.TAU_23,
    State.TAU_3: State.TAU_30,
    State.TAU_S: State.TAU_S0,
}

OUTCOME_OFFSET = 100  # tells outcomes from states in ``transition_table``


def transition_table() -> npt.NDArray[np.int64]:
    """Return TRANSITIONS for the kernels (10, 9): entry [state, touch] is a state, or OUTCOME_OFFSET + outcome."""
    table = np.full((len(State), len(Touch)), -1, dtype=np.int64)
    for state in State:
        for touch, value in TRANSITIONS[CONTINUES_AS.get(state, state)].items():
            table[state, touch] = value + (OUTCOME_OFFSET if isinstance(value, Outcome) else 0)
    return table
