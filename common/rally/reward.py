"""The paper's reward: R, one literal table, and the penalty e_r.

reward = one-hot(tau) R[stage] - e_r (the paper prints plus; all its coefficients are positive, so plus would
pay for torque and jitter). Every entry of R is a sum of a constant and four features:

    g        1/(1 + d_rb^2)^2, d_rb the distance of racket and ball [m]
    speed    x velocity of the racket's contact point just before contact, clipped to 0..10 m/s
    aim      1/(1 + d_bt^2)^2, d_bt the distance of ball and target [m], in space
    landing  1/(1 + (e_lt/s)^2)^2, e_lt the planar landing error [m], s the length scale (the paper's: 1 m)
"""

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from common.rally.trajectory import State

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
}
# fmt: on

TERMS = ("catch_approach", "bounce", "contact", "aim", "landing", "torque", "jitter", "collision")
"""Names of the reward's parts, in the order that kernels and rollouts report them."""


class RewardConfig(BaseModel):
    """What the reward leaves to choose."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reference_rate_hz: float = Field(
        50.0,
        gt=0,
        le=1000,
        description="rate at which continuous rows, torque and collision are paid unscaled",
        json_schema_extra={"unit": "Hz"},
    )
    torque: float = Field(
        0.02, ge=0, le=10, description="c: weight of sum |T_i|/T_max,i", json_schema_extra={"unit": "-"}
    )
    jitter: float = Field(
        0.02, ge=0, le=10, description="d: weight of sum (a(t) - a(t-1))^2", json_schema_extra={"unit": "-"}
    )
    collision: float = Field(
        0.1, ge=0, le=10, description="e: weight of sum min(F_c/50 N, 1)", json_schema_extra={"unit": "-"}
    )
    landing_scale: float = Field(
        0.5,
        gt=0,
        le=10,
        description="length scale s of the landing reward; the paper's is 1",
        json_schema_extra={"unit": "m"},
    )
    heading: float = Field(
        100.0,
        ge=0,
        le=1000,
        description="stage 3: bonus right after the contact, w/(1 + (e/s)^2), e from the target to where the ball is "
        "heading; half of it if that is the net. The paper's is 0",
        json_schema_extra={"unit": "-"},
    )
    heading_scale: float = Field(
        0.5, gt=0, le=10, description="its length scale s", json_schema_extra={"unit": "m"}
    )
    stage_2_landing: float = Field(
        0.0,
        ge=0,
        le=100,
        description="bonus for a legal landing in stage 2; the paper's is 0",
        json_schema_extra={"unit": "-"},
    )


PAPER_REWARD = RewardConfig(landing_scale=1.0, heading=0.0)
"""The paper's: R and e_r, and nothing besides."""


def reward_table(config: RewardConfig) -> npt.NDArray[np.float64]:
    """Return R for the kernels: [stage - 1, state, feature], (3, 8, 5)."""
    table = np.array([[R[state][stage] for state in State] for stage in range(3)])
    table[1, State.TAU_3, FEATURES.index("constant")] += config.stage_2_landing
    return table
