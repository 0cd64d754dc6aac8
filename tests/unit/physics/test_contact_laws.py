"""Mechanics that both bounces must satisfy for any coefficients."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from common.physics.constants import RUBBERS, Rubber
from common.physics.racket_bounce import racket_bounce
from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec
from tests.unit.physics.contacts import (
    BALL_INERTIA,
    BALL_MASS,
    BALL_RADIUS,
    Contact,
    contacts,
    kinetic_energy,
    mirrored,
    mirrored_spin,
    slip_of,
)

GRAZING = Contact((9.0, 0.0, -0.1), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))

table_frictions = st.floats(0.0, 0.6)
table_restitutions = st.floats(0.9, 1.0)
rubbers = st.one_of(
    st.sampled_from(list(RUBBERS.values())),
    st.builds(
        Rubber,
        st.floats(0.5, 1.0),
        st.floats(0.0, 0.03),
        st.floats(0.0, 0.8),  # alpha above 4/5 would create energy
        st.floats(0.0, 0.5),
        st.one_of(st.just(math.inf), st.floats(0.0, 1.0)),
    ),
)


def on_table(contact: Contact, restitution0: float = 0.98, friction: float = 0.25) -> tuple[Vec, Vec]:
    return table_bounce(contact.vel, contact.spin, contact.normal, restitution0, friction)


def on_racket(contact: Contact, rubber: Rubber) -> tuple[Vec, Vec]:
    return racket_bounce(contact.vel, contact.spin, contact.normal, contact.surface_vel, rubber)


def expect_energy_ledger(contact: Contact, vel: Vec, spin: Vec, spin_loss: float) -> None:
    """dKE = -1/2 m (1 - e^2) u_n^2 - 1/2 (2m/5)(1 - e_t^2)|c|^2 - drill, in the frame of the surface.

    e and e_t are read off the outcome (u_n+ = -e u_n, c+ = -e_t c), not taken from the law.
    """
    n = np.array(contact.normal)
    u_n = float(np.subtract(contact.vel, contact.surface_vel) @ n)
    u_n_after = float(np.subtract(vel, contact.surface_vel) @ n)
    c = slip_of(contact.vel, contact.spin, contact)
    c_after = slip_of(vel, spin, contact)
    drill = 0.5 * BALL_INERTIA * (1.0 - (1.0 - spin_loss) ** 2) * float(np.dot(contact.spin, n)) ** 2

    change = kinetic_energy(vel, spin, contact.surface_vel) - kinetic_energy(
        contact.vel, contact.spin, contact.surface_vel
    )
    ledger = (
        -0.5 * BALL_MASS * (u_n**2 - u_n_after**2)
        - 0.5 * (0.4 * BALL_MASS) * (c @ c - c_after @ c_after)
        - drill
    )
    assert change == pytest.approx(ledger, abs=1e-9)
    assert change <= 1e-12
    np.testing.assert_allclose(np.cross(c, c_after), 0.0, atol=1e-9 * (1.0 + c @ c))


def expect_momentum_balance(contact: Contact, vel: Vec, spin: Vec) -> None:
    """m (v+ - v) = J and I (w+ - w) = J_M = -r n x J_t, along the surface; the drill acts along n only."""
    n = np.array(contact.normal)
    J = BALL_MASS * np.subtract(vel, contact.vel)
    dL = BALL_INERTIA * np.subtract(spin, contact.spin)
    dL_along_surface = dL - (dL @ n) * n

    np.testing.assert_allclose(dL_along_surface, np.cross(-BALL_RADIUS * n, J), atol=1e-12)
    assert J @ n > 0.0


@given(contacts(moving=False), table_restitutions, table_frictions)
@example(GRAZING, 0.98, 0.25)
def test_the_table_conserves_energy_with_its_losses(contact: Contact, restitution0: float, friction: float):
    vel, spin = on_table(contact, restitution0, friction)

    expect_energy_ledger(contact, vel, spin, spin_loss=0.0)


@given(contacts(), rubbers)
def test_the_racket_conserves_energy_with_its_losses_in_the_frame_of_its_surface(
    contact: Contact, rubber: Rubber
):
    vel, spin = on_racket(contact, rubber)

    expect_energy_ledger(contact, vel, spin, rubber.spin_loss)


@given(contacts(moving=False), table_restitutions, table_frictions)
def test_the_table_keeps_linear_and_angular_momentum(contact: Contact, restitution0: float, friction: float):
    vel, spin = on_table(contact, restitution0, friction)

    expect_momentum_balance(contact, vel, spin)
    assert np.dot(spin, contact.normal) == pytest.approx(np.dot(contact.spin, contact.normal), abs=1e-9)


@given(contacts(), rubbers)
def test_the_racket_keeps_linear_and_angular_momentum(contact: Contact, rubber: Rubber):
    vel, spin = on_racket(contact, rubber)

    expect_momentum_balance(contact, vel, spin)
    kept = (1.0 - rubber.spin_loss) * np.dot(contact.spin, contact.normal)
    assert np.dot(spin, contact.normal) == pytest.approx(kept, abs=1e-9)


@given(contacts(), rubbers)
def test_a_bounce_on_a_moving_racket_is_the_bounce_on_a_racket_at_rest_in_its_frame(
    contact: Contact, rubber: Rubber
):
    still = Contact(
        tuple(np.subtract(contact.vel, contact.surface_vel)), contact.spin, contact.normal, (0.0, 0.0, 0.0)
    )
    vel, spin = on_racket(contact, rubber)
    vel_still, spin_still = on_racket(still, rubber)

    np.testing.assert_allclose(vel, np.add(vel_still, contact.surface_vel), atol=1e-9)
    np.testing.assert_allclose(spin, spin_still, atol=1e-6)  # rad/s: rounding times 3/2r


@given(contacts(), rubbers)
def test_bounces_on_the_racket_are_mirror_symmetric(contact: Contact, rubber: Rubber):
    image = Contact(
        mirrored(contact.vel),
        mirrored_spin(contact.spin),
        mirrored(contact.normal),
        mirrored(contact.surface_vel),
    )
    vel, spin = on_racket(contact, rubber)
    vel_image, spin_image = on_racket(image, rubber)

    assert (vel_image, spin_image) == (mirrored(vel), mirrored_spin(spin))


@given(contacts(moving=False))
def test_bounces_on_the_table_are_mirror_symmetric(contact: Contact):
    image = Contact(
        mirrored(contact.vel), mirrored_spin(contact.spin), mirrored(contact.normal), contact.surface_vel
    )
    vel, spin = on_table(contact)
    vel_image, spin_image = on_table(image)

    assert (vel_image, spin_image) == (mirrored(vel), mirrored_spin(spin))


@given(contacts(moving=False))
def test_the_table_agrees_with_the_passive_hard_rubber(contact: Contact):
    """A rubber with alpha = 2/5, Coulomb friction and no spin loss is a table."""
    table_like = Rubber(0.98, 0.02, 0.4, 0.0, 0.25)

    np.testing.assert_allclose(on_table(contact), on_racket(contact, table_like), rtol=1e-12, atol=1e-12)
