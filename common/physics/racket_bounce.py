"""Ball on racket: the bounce of a spinning ball on moving rubber."""

from common.jit import kernel
from common.physics.constants import MIN_RESTITUTION
from common.physics.impulse import rebound
from common.physics.vec import Vec, add, axpy, dot, sub


@kernel
def racket_restitution(normal_speed: float, restitution0: float, restitution_slope: float) -> float:
    """Return e_n = max(0.2, e_0 - slope |u_n|) (Conti et al. 2026; Gossard 2026, measured at 2-12 m/s)."""
    return max(MIN_RESTITUTION, restitution0 - restitution_slope * normal_speed)


@kernel
def racket_bounce(
    vel: Vec,
    spin: Vec,
    normal: Vec,
    surface_vel: Vec,
    restitution0: float,
    restitution_slope: float,
    alpha: float,
    spin_loss: float,
    friction: float,
) -> tuple[Vec, Vec]:
    """Return velocity and spin just after the ball met the racket (Nakashima, ACC 2010; Conti et al. 2026).

    Rubber stores tangential strain and gives it back: alpha lies above the 2/5 of rolling and knows no
    Coulomb limit, unless the rubber is a slippery one (finite ``friction``). The impulse on the ball is
    m (v+ - v); the racket takes the opposite one, at p - r n.

    Args:
        vel: Of the ball just before, approaching the surface: (v - V_c).n < 0 [m/s].
        spin: Of the ball just before [rad/s].
        normal: Unit normal n of the face, to the side the ball is on.
        surface_vel: V_c = V_R + W_R x (p - r n - p_R), the racket's velocity where the ball touches [m/s].
        restitution0: e_0 [-].
        restitution_slope: Fall of e_n per speed of impact [s/m].
        alpha: k_p/m [-].
        spin_loss: c_s [-]: w+ loses this share of its part along n (the patch of contact drills).
        friction: mu [-], inf for none.
    """
    u = sub(vel, surface_vel)
    restitution = racket_restitution(-dot(u, normal), restitution0, restitution_slope)
    dv, dw = rebound(u, spin, normal, restitution, alpha, friction)
    turned = add(spin, dw)
    return add(vel, dv), axpy(-spin_loss * dot(turned, normal), normal, turned)
