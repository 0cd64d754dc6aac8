"""What the racket gets of a contact: the opposite of the ball's change of momentum, at the contact point."""

import numpy as np
import pytest

from common.physics.chain import racket_pose
from common.robot.chain_of import chain_of
from common.task.states import State
from tests.unit.rally.scripted import HOME, play_ball

CENTRE = np.array(racket_pose(chain_of("rails"), HOME).centre)
BELOW, BESIDE = np.array([0.0, 0.0, -0.05]), np.array([0.0, 0.04, 0.0])


def hit_at(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return impulse [N s] and its moment about the racket's centre [N m s] of a flat ball of 8 m/s."""
    fall = 9.81 / 2 * 0.010**2  # on 0.08 m
    start = CENTRE + offset + [0.08 + 0.0265, 0.0, fall]
    played = play_ball(start, (-8, 0, 0), state=State.TAU_12, joints=HOME, steps=1)
    assert played.caught
    gained = 0.0027 * (played.balls[0, 3:6] - [-8.0, 0.0, -9.81 * 0.020])  # gravity's part of the step aside
    np.testing.assert_allclose(played.impulses[0, :3], -gained, atol=1e-12)
    return played.impulses[0, :3], played.impulses[0, 3:]


@pytest.mark.parametrize("offset", [0 * BELOW, BELOW, BESIDE], ids=["centre", "below", "beside"])
def test_the_racket_gets_the_opposite_of_the_balls_change_of_momentum(offset):
    """e = 0.878 - 0.020 x 8 = 0.718: 2.7 g x 1.718 x 8 m/s = 0.0371 N s. The face is tilted by 2 degrees."""
    force, _ = hit_at(offset)

    assert force[0] == pytest.approx(-0.0027 * 1.718 * 8.0, rel=0.01)


def test_a_ball_below_the_centre_and_one_to_the_left_turn_the_racket_their_way():
    """r x J with J along -x: about +y for r along -z, about +z for r along y."""
    (force, below), (_, beside) = hit_at(BELOW), hit_at(BESIDE)

    assert below[1] == pytest.approx(-0.05 * force[0], rel=0.05)
    assert beside[2] == pytest.approx(-0.04 * force[0], rel=0.05)
    assert np.abs(hit_at(0 * BELOW)[1]).max() < 0.05 * abs(below[1])
