"""The ends of table, net and floor, by balls that just touch or just miss them. The numbers are those of the ITTF."""

import pytest

from common.physics.chain import RacketPose
from common.physics.flight import SIMPLE, Air
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.touch import Touch, racket_gap
from common.physics.vec import Vec

MM = 0.001
RADIUS = 0.020
NO_SPIN = (0.0, 0.0, 0.0)
NO_AIR = Air(0.0, 0.0, SIMPLE)


def first_touch(pos: Vec, vel: Vec, duration: float = 0.05) -> tuple[Touch, Vec]:
    """Return the first touch of a ball without drag and lift, and its place."""
    place, _, _, what, _ = fly_to_touch(pos, vel, NO_SPIN, duration, NO_AIR, NO_ROBOT)
    return Touch(what), place


def across_the_net(y: float, z: float = 0.05) -> Touch:
    """Return the touch of a fast ball through the net's plane: it falls 0.3 mm on its way to the net."""
    return first_touch((0.08, y, z), (-10.0, 0.0, 0.0), 0.02)[0]


@pytest.mark.parametrize("side", [-1, 1])
def test_the_net_ends_15_25_cm_outside_the_side_lines(side):
    """0.7625 + 0.1525 = 0.915 m from the middle."""
    assert across_the_net(side * (0.915 + RADIUS - MM)) == Touch.NET
    assert across_the_net(side * (0.915 + RADIUS + MM)) == Touch.NONE


def test_the_net_is_15_25_cm_high():
    fall = 9.81 / 2 * 0.008**2  # until x = 0

    assert across_the_net(0.0, 0.1525 + RADIUS + fall - MM) == Touch.NET
    assert across_the_net(0.0, 0.1525 + RADIUS + fall + MM) == Touch.NONE


def test_a_net_of_3_mm_half_thickness_is_touched_by_the_balls_surface():
    touch, place = first_touch((0.3, 0.0, 0.08), (-10.0, 0.0, 0.0))

    assert touch == Touch.NET
    assert place[0] == pytest.approx(0.003 + RADIUS, abs=1e-6)


def dropped(x: float, y: float) -> tuple[Touch, Vec]:
    return first_touch((x, y, 0.1), (0.0, 0.0, -3.0))


@pytest.mark.parametrize(("x", "court"), [(-1, Touch.ROBOT_COURT), (1, Touch.OPPONENT_COURT)])
def test_the_courts_end_at_the_lines_of_a_table_of_274_by_152_5_cm(x, court):
    for inside, outside in (
        ((x * (1.37 - MM), 0.0), (x * (1.37 + MM), 0.0)),
        ((x * 0.5, 0.7625 - MM), (x * 0.5, 0.7625 + MM)),
        ((x * 0.5, -0.7625 + MM), (x * 0.5, -0.7625 - MM)),
    ):
        assert dropped(*inside)[0] == court
        assert dropped(*outside)[0] == Touch.EDGE


def test_a_ball_one_radius_beside_the_table_touches_nothing_of_it():
    assert dropped(-1.37 - RADIUS + MM, 0.0)[0] == Touch.EDGE
    assert dropped(-1.37 - RADIUS - MM, 0.0)[0] == Touch.NONE


def test_the_table_is_touched_when_the_balls_centre_is_2_cm_above_it():
    assert dropped(-0.5, 0.0)[1][2] == pytest.approx(RADIUS, abs=1e-6)


@pytest.mark.parametrize("x", [-0.7, 0.7])
def test_the_underside_of_the_table_is_no_court(x):
    touch, place = first_touch((x, 0.2, -0.2), (0.0, 0.0, 6.0))

    assert touch == Touch.EDGE
    assert place[2] == pytest.approx(-0.025 - RADIUS, abs=1e-6)


def test_the_floor_is_76_cm_below_the_tables_top():
    touch, place = first_touch((-2.0, 0.0, -0.6), (0.0, 0.0, -5.0))

    assert touch == Touch.FLOOR
    assert place[2] == pytest.approx(-0.76 + RADIUS, abs=1e-6)


def across_the_net_at(speed: float, start: float, z: float) -> Touch:
    return first_touch((start, 0.0, z), (-speed, 0.0, 0.0), 0.02)[0]


def test_a_ball_that_grazes_the_net_for_half_a_millisecond_touches_it():
    """At 20 m/s and 0.05 mm deep it is inside for 6 mm of net and 2 x 1.4 mm, 0.44 ms. It starts 40 places apart."""
    for k in range(40):
        start = 0.05 + 0.0025 * k
        fall = 9.81 / 2 * (start / 20.0) ** 2

        assert across_the_net_at(20.0, start, 0.1525 + RADIUS + fall - 0.05 * MM) == Touch.NET


def test_a_ball_that_is_a_nanometre_inside_an_obstacle_touches_it_if_it_goes_deeper():
    deeper, place = first_touch((-0.5, 0.0, RADIUS - 1e-9), (0.0, 0.0, -3.0))

    assert deeper == Touch.ROBOT_COURT
    assert place[2] == pytest.approx(RADIUS, abs=1e-8)


def test_a_ball_that_is_a_nanometre_inside_an_obstacle_does_not_touch_it_again_as_it_leaves():
    assert first_touch((-0.5, 0.0, RADIUS - 1e-9), (0.0, 0.0, 3.0))[0] == Touch.NONE


# A disc in the plane z = 0 with two flat faces and a round rim
RACKET = RacketPose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.076, 0.0065)
R, T = 0.076, 0.0065


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_both_faces_are_flat_and_their_normal_points_to_the_ball(side, share):
    gap, normal = racket_gap((share * (R - T), 0.0, side * (T + RADIUS + MM)), RACKET)

    assert gap == pytest.approx(MM, abs=1e-12)
    assert normal == pytest.approx((0.0, 0.0, side))


def test_the_rim_ends_at_the_rackets_radius():
    gap, normal = racket_gap((0.0, R + RADIUS + MM, 0.0), RACKET)

    assert gap == pytest.approx(MM, abs=1e-12)
    assert normal == pytest.approx((0.0, 1.0, 0.0))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_at_the_rim_the_normal_turns_outwards(side):
    """45 degrees about the middle of the rim's half circle."""
    reach = (T + RADIUS + MM) / 2**0.5
    gap, normal = racket_gap((R - T + reach, 0.0, side * reach), RACKET)

    assert gap == pytest.approx(MM, abs=1e-12)
    assert normal == pytest.approx((0.5**0.5, 0.0, side * 0.5**0.5))
