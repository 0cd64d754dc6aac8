"""The reward: the paper's matrix R, one literal table, and the penalty e_r.

    reward = one-hot(tau) R[stage] - e_r

The paper prints a plus before e_r. All coefficients of e_r are positive, so a plus would reward torque and jitter.
Every entry of R is a sum of a constant and four features:

    g        1/(1 + d_rb^2)^2, d_rb the distance of racket and ball [m]
    speed    x velocity of the racket's contact point just before the contact, clipped to 0..10 m/s
    aim      1/(1 + d_bt^2)^2, d_bt the distance of ball and target in space [m]
    landing  1/(1 + (e_lt/s)^2)^2, e_lt the planar landing error [m], s the length scale (1 m in the paper)
"""

import numpy as np
import numpy.typing as npt

from common.task.states import State

FEATURES = ("constant", "g", "speed", "aim", "landing")

_0 = (0.0, 0.0, 0.0, 0.0, 0.0)

# fmt: off
R: dict[State, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    #              stage 1: catch                 stage 2: hit                   stage 3: aim
    #              const   g   speed aim land
    State.TAU_0:  (_0,                            _0,                            _0),
    State.TAU_01: ((0.0,  1.0, 0.0, 0.0, 0.0),    (0.0,  0.25, 0.0, 0.0, 0.0),   (0.0,  0.1, 0.0, 0.0, 0.0)),
    State.TAU_1:  ((10.0, 0.0, 0.0, 0.0, 0.0),    (4.0,  0.0,  0.0, 0.0, 0.0),   (1.0,  0.0, 0.0, 0.0, 0.0)),
    State.TAU_12: ((0.0,  1.0, 0.0, 0.0, 0.0),    (0.0,  0.25, 0.0, 0.0, 0.0),   (0.0,  0.1, 0.0, 0.0, 0.0)),
    State.TAU_2:  ((25.0, 0.0, 0.0, 0.0, 0.0),    (50.0, 0.0,  1.0, 0.0, 0.0),   (10.0, 0.0, 0.0, 0.0, 0.0)),
    State.TAU_23: (_0,                            _0,                            (0.0,  0.0, 0.0, 1.0, 0.0)),
    State.TAU_3:  (_0,                            _0,                            (30.0, 0.0, 0.0, 0.0, 40.0)),
    State.TAU_30: (_0,                            _0,                            _0),
    # not in the paper: a serve on its way to the server's own court is a ball that comes
    State.TAU_S:  (_0,                            _0,                            _0),
    State.TAU_S0: ((0.0,  1.0, 0.0, 0.0, 0.0),    (0.0,  0.25, 0.0, 0.0, 0.0),   (0.0,  0.1, 0.0, 0.0, 0.0)),
}
# fmt: on

TERMS = ("catch_approach", "bounce", "contact", "aim", "landing", "torque", "jitter", "collision")
"""Names of the reward's terms, in the order of kernels and rollouts."""


def reward_table() -> npt.NDArray[np.float64]:
    """Return R for the kernels (3, 10, 5): entry [stage - 1, state, feature]."""
    return np.array([[R[state][stage] for state in State] for stage in range(3)])
