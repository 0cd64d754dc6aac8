"""Ball on table: the bounce of a spinning ball on a hard plane at rest."""

from common.jit import kernel
from common.physics.constants import MIN_RESTITUTION, ROLLING_ALPHA, TABLE_RESTITUTION_SLOPE
from common.physics.impulse import rebound
from common.physics.vec import Vec, add, dot


@kernel
def table_restitution(normal_speed: float, restitution0: float) -> float:
    """Return e_n = max(0.2, e_0 - 0.02 |v_n|): a faster impact dents the shell more (Conti et al. 2026)."""
    return max(MIN_RESTITUTION, restitution0 - TABLE_RESTITUTION_SLOPE * normal_speed)


@kernel
def table_bounce(vel: Vec, spin: Vec, normal: Vec, restitution0: float, friction: float) -> tuple[Vec, Vec]:
    """Return velocity and spin just after a contact with the table (Nakashima, ACC 2010; Conti et al. 2026).

    alpha = min(2/5, mu (1 + e_n)|v_n| / |c|): the ball leaves rolling, or it slides during the whole contact.

    Args:
        vel: Just before, approaching: v.n < 0 [m/s].
        spin: Just before [rad/s].
        normal: Unit normal n on the ball's side: (0, 0, 1) on the table top.
        restitution0: e_0 [-], nominal 0.98.
        friction: mu [-], nominal 0.25.
    """
    restitution = table_restitution(-dot(vel, normal), restitution0)
    dv, dw = rebound(vel, spin, normal, restitution, ROLLING_ALPHA, friction)
    return add(vel, dv), add(spin, dw)
