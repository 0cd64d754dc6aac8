"""The impulse of a rigid ball on a surface, in the surface's frame: the common law of table and racket."""

from common.jit import kernel
from common.physics.constants import BALL_RADIUS, SPIN_PER_VELOCITY
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale


@kernel
def slip(u: Vec, spin: Vec, normal: Vec) -> Vec:
    """Return c = u - u_n n + r (n x w), the tangential velocity of the ball's contact point [m/s].

    Args:
        u: Velocity of the ball's centre relative to the surface [m/s].
        spin: w [rad/s].
        normal: Unit normal n of the surface, on the ball's side.
    """
    tangential = axpy(-dot(u, normal), normal, u)
    return add(tangential, scale(BALL_RADIUS, cross(normal, spin)))


@kernel
def rebound(
    u: Vec, spin: Vec, normal: Vec, restitution: float, alpha_max: float, friction: float
) -> tuple[Vec, Vec]:
    """Return the changes of velocity and spin in one contact (Nakashima, ACC 2010; Conti et al. 2026).

    dv = -(1 + e_n) u_n n - alpha c and dw = (3 alpha/2r)(n x c). With J = m dv this is I dw = -r n x J_t, so
    linear and angular momentum are conserved by construction.

    Args:
        u: Velocity of the ball's centre relative to the surface, approaching: u_n = u.n < 0 [m/s].
        spin: w [rad/s].
        normal: Unit normal n of the surface, on the ball's side.
        restitution: e_n [-].
        alpha_max: alpha of a contact that sticks [-].
        friction: mu [-]. If |J_t| would exceed mu J_n, the contact slides and alpha is smaller.
    """
    u_n = dot(u, normal)
    c = slip(u, spin, normal)
    c_norm = norm(c)
    grip = friction * (1.0 + restitution) * -u_n
    alpha = alpha_max
    # written as a product, so that c = 0 and infinite friction need no special case
    if grip < alpha_max * c_norm:
        alpha = grip / c_norm
    dv = axpy(-(1.0 + restitution) * u_n, normal, scale(-alpha, c))
    return dv, scale(SPIN_PER_VELOCITY * alpha, cross(normal, c))
