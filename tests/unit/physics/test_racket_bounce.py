"""The rubber's law: how a racket's bounce differs from the table's."""

import math

import numpy as np
import pytest

from common.physics.constants import ANTI_SPIN, INVERTED, LONG_PIPS, RUBBERS, Rubber
from common.physics.racket_bounce import racket_bounce
from common.physics.vec import Vec
from tests.unit.physics.contacts import Contact, slip_of

FACING_OPPONENT = (1.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)


def bounce(vel: Vec, spin: Vec = STILL, rubber: Rubber = INVERTED, surface_vel: Vec = STILL):
    return racket_bounce(vel, spin, FACING_OPPONENT, surface_vel, rubber)


def test_a_still_racket_returns_a_flat_ball_with_the_measured_restitution():
    vel, _ = bounce((-5.0, 0.0, 0.0))

    np.testing.assert_allclose(vel, [0.778 * 5.0, 0.0, 0.0])


def test_restitution_never_falls_below_its_floor():
    vel, _ = bounce((-60.0, 0.0, 0.0))

    assert vel[0] == pytest.approx(0.2 * 60.0)


def test_a_racket_that_swings_adds_its_speed_once_and_its_restitution():
    vel, _ = bounce((-5.0, 0.0, 0.0), surface_vel=(4.0, 0.0, 0.0))

    assert vel[0] == pytest.approx(4.0 + (0.878 - 0.020 * 9.0) * 9.0)


@pytest.mark.parametrize("rubber", RUBBERS.values(), ids=RUBBERS.keys())
def test_slip_is_returned_with_the_rubbers_tangential_restitution(rubber):
    """c+ = -e_t c, e_t = 2.5 alpha - 1, in a contact that sticks."""
    contact = Contact((-6.0, 1.0, 0.3), (0.0, 0.0, 0.0), FACING_OPPONENT, STILL)
    vel, spin = bounce(contact.vel, contact.spin, rubber)
    c = slip_of(contact.vel, contact.spin, contact)

    np.testing.assert_allclose(slip_of(vel, spin, contact), -(2.5 * rubber.alpha - 1.0) * c, atol=1e-12)


def test_inverted_rubber_reverses_incoming_topspin_and_long_pips_do_not():
    topspin = (0.0, -100.0, 0.0)
    _, inverted = bounce((-6.0, 0.0, 0.0), topspin)
    _, pips = bounce((-6.0, 0.0, 0.0), topspin, LONG_PIPS)

    assert inverted[1] > 0.0
    assert topspin[1] < pips[1] < 0.0


def test_anti_spin_slips_at_its_coulomb_limit():
    vel, _ = bounce((-4.0, 0.0, 0.0), (0.0, -400.0, 0.0), ANTI_SPIN)

    assert abs(vel[2]) == pytest.approx(0.189 * (1.0 + 0.533) * 4.0)


def test_the_contact_patch_reduces_spin_about_the_normal():
    _, spin = bounce((-5.0, 0.0, 0.0), (100.0, 0.0, 0.0))

    np.testing.assert_allclose(spin, [80.0, 0.0, 0.0])


def test_both_faces_of_the_racket_have_the_same_law():
    front, _ = racket_bounce((-5.0, 1.0, 0.0), STILL, (1.0, 0.0, 0.0), STILL, INVERTED)
    back, _ = racket_bounce((5.0, 1.0, 0.0), STILL, (-1.0, 0.0, 0.0), STILL, INVERTED)

    assert back == (-front[0], front[1], front[2])


def test_a_rubber_without_coulomb_limit_sticks_at_any_slip():
    vel, _ = bounce((-0.1, 20.0, 0.0), rubber=Rubber(0.9, 0.0, 0.7, 0.0, math.inf))

    assert vel[1] == pytest.approx(0.3 * 20.0)
