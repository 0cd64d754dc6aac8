"""The paper's collision equations (its eq. 2, signs corrected) and the table's law against resolved contacts.

A free ball touches MuJoCo's own compliant table in steps of a microsecond. The contact forces f_k and torques M_k about
the centre of each step give the paper's integrals as sums:

    J_f = sum f_k h,    J_M = sum M_k h,    W_f = sum f_k . ds_k,    W_M = sum M_k . dtheta_k
    m v = m u + J_f,    I w = I w_0 + J_M,    m v^2 + I w^2 = m u^2 + I w_0^2 + 2 W_f + 2 W_M

They hold for any contact force, so they test the sums and not the ball. The table's law is compared with the changes
along the table: MuJoCo's friction is Coulomb's, given enough steps. Its convex friction cone also separates sliding
surfaces, so the restitution of a contact with slip is MuJoCo's own (0.2 to 1.0), and the law gets that value.
"""

from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from common.physics.table_bounce import table_bounce
from common.physics.vec import Vec
from tests.unit.physics.contacts import BALL_INERTIA, BALL_MASS, BALL_RADIUS

STEP = 1e-6  # s
STIFFNESS = 15_000.0**2  # 1/s^2: a contact of 0.2 ms, 0.2 mm deep at 3 m/s
FRICTION = 0.25

# solref < 0: stiffness and damping per mass, given directly. The slip is damped within 5 us, up to
# Coulomb's limit.
MODEL = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0" cone="elliptic" tolerance="0" iterations="50"/>
  <worldbody>
    <geom name="table" type="plane" size="2 1 .1"/>
    <body>
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <geom name="ball" type="sphere" size="{radius}"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="table" geom2="ball" condim="3" friction="{friction} {friction}"
          solref="-{stiffness} -{damping}" solreffriction="0 -2e5" solimp=".9999 .9999 .001"/>
  </contact>
</mujoco>
"""


class Bounce(NamedTuple):
    """A resolved contact: the ball before and after, and the sums over its steps."""

    u: np.ndarray
    w_0: np.ndarray
    v: np.ndarray
    w: np.ndarray
    J_f: np.ndarray
    J_M: np.ndarray
    W_f: np.ndarray  # by component; their sum is the work
    W_M: np.ndarray
    W_f_end: np.ndarray  # with ds_k = v_{k+1} h, as a simulator's own step moves the ball
    steps: int


def world_spin(data: mujoco.MjData) -> np.ndarray:
    """Return the ball's spin in the world: MuJoCo keeps a free joint's in the body's frame."""
    spin = np.zeros(3)
    mujoco.mju_rotVecQuat(spin, data.qvel[3:6], data.qpos[3:7])
    return spin


def contact_wrench(model: mujoco.MjModel, data: mujoco.MjData, centre: np.ndarray) -> np.ndarray:
    """Return force and torque about ``centre`` of all contacts of the last step, (2, 3)."""
    wrench, in_contact_frame = np.zeros((2, 3)), np.zeros(6)
    for k, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, k, in_contact_frame)
        force = contact.frame.reshape(3, 3).T @ in_contact_frame[:3]
        wrench += [force, np.cross(contact.pos - centre, force)]
    return wrench


def resolve(vel: Vec, spin: Vec, damping: float = 900.0) -> Bounce:
    """Return the contact of a ball that stands one micrometre above the table."""
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(
            step=STEP,
            mass=BALL_MASS,
            inertia=BALL_INERTIA,
            radius=BALL_RADIUS,
            friction=FRICTION,
            stiffness=STIFFNESS,
            damping=damping,
        )
    )
    data = mujoco.MjData(model)
    data.qpos[:3] = [0.0, 0.0, BALL_RADIUS + 1e-6]
    data.qvel[:] = [*vel, *spin]
    impulse, work, work_end = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))
    steps = 0
    while steps == 0 or data.qpos[2] < BALL_RADIUS or data.qvel[2] < 0.0:
        centre = data.qpos[:3].copy()
        before = np.array([data.qvel[:3], world_spin(data)])
        mujoco.mj_step(model, data)
        after = np.array([data.qvel[:3], world_spin(data)])
        wrench = contact_wrench(model, data, centre)
        impulse += STEP * wrench
        work += STEP * wrench * (before + after) / 2
        work_end += STEP * wrench * after
        steps += 1
    return Bounce(
        np.array(vel), np.array(spin), *after, impulse[0], impulse[1], work[0], work[1], work_end[0], steps
    )


BOUNCES = {
    "topspin": ((-5.0, 0.0, -3.0), (0.0, -400.0, 0.0)),
    "backspin": ((-5.0, 0.0, -3.0), (0.0, 300.0, 0.0)),
    "flat": ((-8.0, 0.0, -3.0), (0.0, 0.0, 0.0)),
    "steep": ((-3.0, 0.0, -5.0), (0.0, 0.0, 0.0)),
    "skew": ((-5.0, 0.5, -3.0), (30.0, -150.0, 20.0)),
    "rolls": ((-1.0, 0.3, -3.0), (0.0, 20.0, 50.0)),
    "slides": ((-10.0, 2.0, -2.0), (100.0, 300.0, 100.0)),
}
every_bounce = pytest.mark.parametrize(("vel", "spin"), BOUNCES.values(), ids=BOUNCES.keys())


def kinetic_energy(vel: np.ndarray, spin: np.ndarray) -> float:
    return float(0.5 * BALL_MASS * vel @ vel + 0.5 * BALL_INERTIA * spin @ spin)


@every_bounce
def test_summed_contact_forces_satisfy_the_papers_corrected_equations(vel, spin):
    bounce = resolve(vel, spin)
    energy_0, energy = kinetic_energy(bounce.u, bounce.w_0), kinetic_energy(bounce.v, bounce.w)

    np.testing.assert_allclose(BALL_MASS * bounce.v, BALL_MASS * bounce.u + bounce.J_f, atol=1e-12)
    np.testing.assert_allclose(
        BALL_INERTIA * bounce.w, BALL_INERTIA * bounce.w_0 + bounce.J_M, atol=1e-9 * BALL_INERTIA * 400
    )
    assert energy == pytest.approx(energy_0 + bounce.W_f.sum() + bounce.W_M.sum(), rel=1e-9)


@every_bounce
def test_the_velocity_after_follows_from_work_over_impulse_per_component(vel, spin):
    """Eq. 2 solved for v: v_i = 2 W_i / J_i - u_i, where the impulse is not 0."""
    bounce = resolve(vel, spin)
    pushed = np.abs(bounce.J_f) > 1e-9

    np.testing.assert_allclose(
        bounce.v[pushed], (2 * bounce.W_f / np.where(pushed, bounce.J_f, 1.0) - bounce.u)[pushed], atol=1e-9
    )
    assert pushed[2]


def test_displacements_taken_at_the_end_of_a_step_miss_the_velocity():
    """The reason for the midpoint: the end of the step overstates the work by sum f^2 h^2 / 2m."""
    bounce = resolve(*BOUNCES["steep"])
    v_z = 2 * bounce.W_f_end[2] / bounce.J_f[2] - bounce.u[2]

    assert v_z - bounce.v[2] > 0.01


@every_bounce
def test_the_tables_law_agrees_with_a_resolved_contact(vel, spin):
    bounce = resolve(vel, spin)
    restitution = bounce.v[2] / -vel[2]
    law_vel, law_spin = table_bounce(vel, spin, (0.0, 0.0, 1.0), restitution + 0.02 * -vel[2], FRICTION)

    assert restitution > 0.2
    # the law's contact has no depth: MuJoCo's lever is shorter by half of its 0.2 mm, half a percent of r
    np.testing.assert_allclose(bounce.v, law_vel, atol=0.005)
    np.testing.assert_allclose(bounce.w, law_spin, atol=0.5)


def test_a_resolved_contact_without_slip_has_the_tables_restitution():
    """Damping of a linear contact, chosen for e = 0.92, the table's at 3 m/s: e ~ exp(-pi zeta)."""
    zeta = -np.log(0.92) / np.pi
    bounce = resolve((0.0, 0.0, -3.0), (0.0, 0.0, 200.0), damping=2 * zeta * np.sqrt(STIFFNESS))
    law_vel, law_spin = table_bounce((0.0, 0.0, -3.0), (0.0, 0.0, 200.0), (0.0, 0.0, 1.0), 0.98, FRICTION)

    np.testing.assert_allclose(bounce.v, law_vel, atol=0.02)
    np.testing.assert_allclose(bounce.w, law_spin, atol=1e-6)


def test_the_resolved_contacts_cover_rolling_and_sliding():
    slip_after = {
        name: abs(bounce.v[0] - BALL_RADIUS * bounce.w[1]) + abs(bounce.v[1] + BALL_RADIUS * bounce.w[0])
        for name, bounce in ((name, resolve(*case)) for name, case in BOUNCES.items())
    }

    assert slip_after["rolls"] < 0.05
    assert slip_after["slides"] > 1.0
