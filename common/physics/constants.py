"""Constants of ball, air, table, net and rubbers: value, unit and source of each.

They are module-level floats, because numba compiles them into the kernels as literals. Parameters that vary from
rally to rally (drag and lift factor, restitution and friction of the table, rubber) are arguments of the kernels.
Their values here are the nominal ones.

Sources: ITTF = ITTF Laws 2.01-2.03; Conti = Conti et al. 2026, arXiv:2606.28805; Gossard = Gossard 2026,
arXiv:2604.11349; Nakashima = Nakashima et al., ACC 2010.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

# Time grid on which every process integrates flight. It divides every control period (5, 10, 20 and 40 ms).
# A rally replays bit for bit because generator, actor and evaluator all take these steps (ADR-0005).
GRID_STEP: Final = 0.005  # s

# Ball
BALL_RADIUS: Final = 0.020  # m; ITTF 40+ plastic ball, measured 40.0-40.6 mm across
BALL_MASS: Final = 2.7e-3  # kg; ITTF
BALL_INERTIA: Final = 2.0 / 3.0 * BALL_MASS * BALL_RADIUS**2  # kg m^2; thin shell
BALL_AREA: Final = math.pi * BALL_RADIUS**2  # m^2; cross section
BALL_VOLUME: Final = 4.0 / 3.0 * math.pi * BALL_RADIUS**3  # m^3
ROLLING_ALPHA: Final = 2.0 / 5.0  # [-] 1/(1 + m r^2/I): a shell that loses this share of its slip rolls
SPIN_PER_VELOCITY: Final = 3.0 / (2.0 * BALL_RADIUS)  # 1/m; m r/I: change of spin per change of velocity

# Air and gravity
GRAVITY: Final = 9.81  # m/s^2
AIR_DENSITY: Final = 1.204  # kg/m^3; 20 degrees C at sea level, Conti
AIR_FACTOR: Final = AIR_DENSITY * BALL_AREA / (2.0 * BALL_MASS)  # 1/m; rho A/2m = 0.280: scales C_D and C_L
AIR_VOLUME_FACTOR: Final = AIR_DENSITY * BALL_VOLUME / BALL_MASS  # [-] rho V/m = 0.0149: scales C_M

# Table, net, floor in the table frame (origin: centre of the table top)
TABLE_HALF_LENGTH: Final = 1.37  # m; ITTF 2.01.01
TABLE_HALF_WIDTH: Final = 0.7625  # m; ITTF 2.01.01
TABLE_THICKNESS: Final = 0.025  # m; usual competition table (22-28 mm)
FLOOR_Z: Final = -0.76  # m; ITTF 2.01.01
NET_HEIGHT: Final = 0.1525  # m; ITTF 2.02.03
NET_HALF_WIDTH: Final = 0.915  # m; ITTF 2.02.02: the posts stand 15.25 cm outside the side lines

# Restitution falls with the impact speed: e_n = e_0 - slope |v_n|, measured at 2-12 m/s. The minimum limits the
# extrapolation to higher speeds
MIN_RESTITUTION: Final = 0.2  # [-]
TABLE_RESTITUTION0: Final = 0.98  # [-] Conti: 0.93 at 2.4 m/s, 0.88 at 5 m/s
TABLE_RESTITUTION_SLOPE: Final = 0.02  # s/m; Conti
TABLE_FRICTION: Final = 0.25  # [-] Conti, Nakashima; 0.254 and 0.266 on 1,350 recorded bounces


class Rubber(NamedTuple):
    """Parameters of a racket's covering, as ``racket_bounce`` uses them."""

    restitution0: float  # [-] e_0 of e_n = e_0 - slope |u_n|
    restitution_slope: float  # s/m
    alpha: (
        float  # [-] tangential impulse k_p/m: with 0.4 the ball leaves rolling, 0.8 returns all of the slip
    )
    spin_loss: float  # [-] c_s: lost share of the spin about the normal
    friction: float  # [-] Coulomb limit of the tangential impulse; inf: the rubber never slides


INVERTED: Final = Rubber(0.878, 0.020, 0.70, 0.2, math.inf)  # Conti (e, c_s), Nakashima (k_p 1.9e-3 kg)
SHORT_PIPS: Final = Rubber(0.866, 0.0163, 0.69, 0.2, math.inf)  # Gossard racket 8
MEDIUM_PIPS: Final = Rubber(0.772, 0.0138, 0.52, 0.2, math.inf)  # Gossard racket 7
LONG_PIPS: Final = Rubber(0.749, 0.0073, 0.30, 0.2, math.inf)  # Gossard racket 5, sponge 1.2 mm
LONG_PIPS_OX: Final = Rubber(0.729, 0.0055, 0.25, 0.2, math.inf)  # Gossard racket 6, no sponge
# Gossard racket 10: published with a mean restitution only, so without a slope. It slides, or at most rolls like a
# hard surface
ANTI_SPIN: Final = Rubber(0.533, 0.0, ROLLING_ALPHA, 0.2, 0.189)

RUBBERS: Final[Mapping[str, Rubber]] = MappingProxyType(
    {
        "inverted": INVERTED,
        "short_pips": SHORT_PIPS,
        "medium_pips": MEDIUM_PIPS,
        "long_pips": LONG_PIPS,
        "long_pips_ox": LONG_PIPS_OX,
        "anti_spin": ANTI_SPIN,
    }
)
