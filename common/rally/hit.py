"""The last legal contact of racket and ball, as evaluations of the robot read it."""

from typing import Final

import numpy as np
import numpy.typing as npt

from common.jit import kernel
from common.physics.chain import Joints
from common.physics.vec import Vec

Array = npt.NDArray[np.float64]

# Columns of a hit's row: ball and joints at the contact; 1: it was in the newest control step
BALL_POS, JOINT_POS, JOINT_VEL, FRESH = 0, 3, 10, 17
HIT: Final = 18


@kernel
def write_contact(hit: Array, pos: Vec, joints: Joints, rates: Joints) -> None:
    """Write ball and joints at a contact into a hit's row (HIT,)."""
    for k in range(3):
        hit[BALL_POS + k] = pos[k]
    for j in range(7):
        hit[JOINT_POS + j], hit[JOINT_VEL + j] = joints[j], rates[j]
    hit[FRESH] = 1.0
