"""Ball on racket: the bounce of a spinning ball on moving rubber."""

from common.jit import kernel
from common.physics.constants import MIN_RESTITUTION, Rubber
from common.physics.impulse import rebound
from common.physics.vec import Vec, add, axpy, dot, sub


@kernel
def racket_restitution(normal_speed: float, restitution0: float, restitution_slope: float) -> float:
    """Return e_n = max(0.2, e_0 - slope |u_n|) (Conti et al. 2026; Gossard 2026, measured at 2-12 m/s)."""
    return max(MIN_RESTITUTION, restitution0 - restitution_slope * normal_speed)


@kernel
def racket_bounce(vel: Vec, spin: Vec, normal: Vec, surface_vel: Vec, rubber: Rubber) -> tuple[Vec, Vec]:
    """Return velocity and spin just after a contact with the racket (Nakashima, ACC 2010; Conti et al. 2026).

    Rubber stores tangential strain and returns it: alpha is larger than the 2/5 of rolling. There is no Coulomb limit,
    except for slippery rubbers (finite ``friction``). The impulse on the ball is m (v+ - v). The racket gets the
    opposite impulse at p - r n.

    Args:
        vel: Of the ball just before, approaching the surface: (v - V_c).n < 0 [m/s].
        spin: Of the ball just before [rad/s].
        normal: Unit normal n of the face, on the ball's side.
        surface_vel: V_c = V_R + W_R x (p - r n - p_R), the racket's velocity at the contact point [m/s].
        rubber: e_0, its slope, alpha = k_p/m, spin loss c_s and friction mu (inf: no limit).
    """
    u = sub(vel, surface_vel)
    restitution = racket_restitution(-dot(u, normal), rubber.restitution0, rubber.restitution_slope)
    dv, dw = rebound(u, spin, normal, restitution, rubber.alpha, rubber.friction)
    turned = add(spin, dw)
    return add(vel, dv), axpy(-rubber.spin_loss * dot(turned, normal), normal, turned)
