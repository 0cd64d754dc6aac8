"""Ball in the air: gravity, drag and Magnus force, and one step of integration.

    a = -g z + (rho A/2m) (-C_D |v| v + C_L |v|^2 w^ x v^),    S = r|w|/|v|

There are two models of the coefficients, and a third for estimators. On 1,597 recorded flights of 0.3 s the median
error of the landing is 40 mm with the simple model and 35 mm with the full one. With drag alone it is 188 mm, with a
lift that never saturates 65 mm.
"""

from typing import Final, NamedTuple

import numpy as np

from common.jit import kernel
from common.physics.constants import AIR_FACTOR, AIR_VOLUME_FACTOR, BALL_RADIUS, GRAVITY
from common.physics.flight_model import Flight
from common.physics.vec import Vec, axpy, cross, norm

SIMPLE: Final = int(Flight.SIMPLE)  # kernels compare plain integers
FULL: Final = int(Flight.FULL)
LINEAR: Final = int(Flight.LINEAR)


class Air(NamedTuple):
    """The air of one rally."""

    drag_factor: float  # [-] multiplies C_D, nominal 1
    lift_factor: float  # [-] multiplies C_L and its saturation value, nominal 1
    model: int  # ``Flight``


# Simple model: Sony's earlier model, as cited by Conti et al. 2026. Lift saturates at S = 0.25.
SIMPLE_DRAG: Final = 0.55  # [-] C_D
SIMPLE_LIFT_SLOPE: Final = 1.067  # [-] C_L / S
SIMPLE_LIFT_MAX: Final = 0.267  # [-]

# Linear model: near the full one for balls of 3-12 m/s with up to 300 rad/s. Estimators need lift that is linear in
# spin up to a limit
LINEAR_DRAG: Final = 0.52  # [-] C_D
LINEAR_LIFT_SLOPE: Final = 0.78  # [-] C_L / S
LINEAR_LIFT_MAX: Final = 0.285  # [-]

# Full model: C_D(|v|, S), Conti et al. 2026: per speed [m/s], the knots S [-] and the values C_D [-]
DRAG_SPEEDS: Final = np.array([2.5, 7.5, 12.5, 17.5])
DRAG_KNOTS: Final = np.array(
    [
        [0.0, 0.3, 0.70, 0.95, 1.5, 2.0],
        [0.0, 0.4, 0.75, 1.10, 1.3, 2.0],
        [0.0, 0.4, 0.62, 0.95, 1.3, 2.0],
        [0.0, 0.4, 0.50, 0.84, 1.2, 2.0],
    ]
)
DRAG_VALUES: Final = np.array(
    [
        [0.55, 0.55, 0.55, 0.55, 0.55, 0.55],
        [0.49, 0.49, 0.55, 0.48, 0.53, 0.53],
        [0.47, 0.47, 0.53, 0.41, 0.48, 0.48],
        [0.47, 0.47, 0.51, 0.37, 0.45, 0.45],
    ]
)
DRAG_MIN: Final = 0.3  # [-] our limit: the table ends at 17.5 m/s, and its extrapolation needs one

# Full model: C_M(|v|, |w|), Conti et al. 2026: per speed [m/s], a line m_1 w + c_1 up to w_b, and from there a
# parabola a w^2 + b w + c. At w_b they differ by up to 0.022. So that C_M has no jump, this difference is added to the
# parabola and falls linearly to 0 within LIFT_BLEND: our addition to the published model
MAGNUS_SPEEDS: Final = np.array([2.0, 3.5, 7.5, 10.5, 13.5, 17.0])
MAGNUS_PARAMETERS: Final = np.array(
    [  #  m_1       c_1   w_b      a          b          c
        [0.0, 0.080, 150.0, -1.852e-7, -1.296e-4, 0.09833],
        [-1.10e-3, 0.310, 200.0, -1.667e-7, -3.333e-5, 0.1000],
        [
            -7.75e-4,
            0.366,
            350.0,
            -2.000e-7,
            1.700e-4,
            0.05875,
        ],  # from the authors' code; the paper rounds them
        [-6.58e-4, 0.375, 440.0, -2.604e-7, 3.646e-4, -0.02250],
        [-5.60e-4, 0.383, 550.0, -3.571e-7, 5.357e-4, -0.08929],
        [-4.48e-4, 0.371, 650.0, -1.000e-7, 2.300e-4, -0.03750],
    ]
)
LIFT_BLEND: Final = 50.0  # [rad/s] then the blend is no steeper than the published lines


@kernel
def full_drag(speed: float, spin_parameter: float) -> float:
    """Return C_D(|v|, S) of the full model [-]: linear in S and in |v|, knots and values alike.

    At less than 2.5 m/s the first row holds. At more than 17.5 m/s the values are extrapolated along the slope of the
    last two rows, and the knots stay: extrapolated knots would cross at 22 m/s.
    """
    row = 0
    while row < DRAG_SPEEDS.size - 2 and speed >= DRAG_SPEEDS[row + 1]:
        row += 1
    t = max(0.0, (speed - DRAG_SPEEDS[row]) / (DRAG_SPEEDS[row + 1] - DRAG_SPEEDS[row]))
    t_knot = min(t, 1.0)
    s_low = 0.0
    value_low: float = (1.0 - t) * DRAG_VALUES[row, 0] + t * DRAG_VALUES[row + 1, 0]
    for k in range(1, DRAG_KNOTS.shape[1]):
        s_high = (1.0 - t_knot) * DRAG_KNOTS[row, k] + t_knot * DRAG_KNOTS[row + 1, k]
        value_high: float = (1.0 - t) * DRAG_VALUES[row, k] + t * DRAG_VALUES[row + 1, k]
        if spin_parameter < s_high:
            slope = (value_high - value_low) / (s_high - s_low)
            value_low += slope * (spin_parameter - s_low)
            break
        s_low, value_low = s_high, value_high
    return max(DRAG_MIN, value_low)


@kernel
def full_magnus(speed: float, spin_rate: float) -> float:
    """Return C_M(|v|, |w|) of the full model [-]: parameters linear in |v|, constant outside 2-17 m/s, never < 0.

    It is continuous in the spin: from w_b on it approaches the parabola within ``LIFT_BLEND``. C_M is Conti's
    coefficient per volume: a = (rho V/m) C_M (w x v); C_L = (8/3) C_M S for a spin across v.
    """
    row = 0
    while row < MAGNUS_SPEEDS.size - 2 and speed >= MAGNUS_SPEEDS[row + 1]:
        row += 1
    t = (speed - MAGNUS_SPEEDS[row]) / (MAGNUS_SPEEDS[row + 1] - MAGNUS_SPEEDS[row])
    t = min(1.0, max(0.0, t))
    low, high = MAGNUS_PARAMETERS[row], MAGNUS_PARAMETERS[row + 1]
    w_b = (1.0 - t) * low[2] + t * high[2]
    m_1: float = (1.0 - t) * low[0] + t * high[0]
    c_1: float = (1.0 - t) * low[1] + t * high[1]
    if spin_rate <= w_b:
        return max(0.0, m_1 * spin_rate + c_1)
    a: float = (1.0 - t) * low[3] + t * high[3]
    b: float = (1.0 - t) * low[4] + t * high[4]
    c: float = (1.0 - t) * low[5] + t * high[5]
    parabola = (a * spin_rate + b) * spin_rate + c
    beyond = spin_rate - w_b
    if beyond < LIFT_BLEND:
        gap = m_1 * w_b + c_1 - ((a * w_b + b) * w_b + c)
        parabola += gap * (1.0 - beyond / LIFT_BLEND)
    return max(0.0, parabola)


@kernel
def acceleration(vel: Vec, spin: Vec, air: Air) -> Vec:
    """Return the acceleration of a ball in flight [m/s^2].

    Args:
        vel: v [m/s].
        spin: w [rad/s].
        air: Of the rally.
    """
    speed = norm(vel)
    spin_rate = norm(spin)
    # a = -drag v + lift (w x v) - g z. The divisions by |v| and |w| are cancelled, so a ball at rest and a ball
    # without spin need no special case
    if air.model != FULL:
        drag_coefficient, slope, most = SIMPLE_DRAG, SIMPLE_LIFT_SLOPE, SIMPLE_LIFT_MAX
        if air.model == LINEAR:
            drag_coefficient, slope, most = LINEAR_DRAG, LINEAR_LIFT_SLOPE, LINEAR_LIFT_MAX
        drag = AIR_FACTOR * drag_coefficient * speed
        lift = AIR_FACTOR * slope * BALL_RADIUS
        if slope * BALL_RADIUS * spin_rate > most * speed:
            lift = AIR_FACTOR * most * speed / spin_rate
    else:
        spin_parameter = BALL_RADIUS * spin_rate / speed if speed > 0.0 else 0.0
        drag = AIR_FACTOR * full_drag(speed, spin_parameter) * speed
        lift = AIR_VOLUME_FACTOR * full_magnus(speed, spin_rate)
    drag *= air.drag_factor
    lift *= air.lift_factor
    magnus = cross(spin, vel)
    return (
        lift * magnus[0] - drag * vel[0],
        lift * magnus[1] - drag * vel[1],
        lift * magnus[2] - drag * vel[2] - GRAVITY,
    )


@kernel
def flight_step(pos: Vec, vel: Vec, spin: Vec, h: float, air: Air) -> tuple[Vec, Vec]:
    """Return position and velocity after ``h`` seconds of flight: one classical Runge-Kutta step.

    Args:
        pos: Of the ball's centre [m].
        vel: [m/s].
        spin: [rad/s], constant.
        h: Step [s]; ``GRID_STEP`` where a rally must replay bit for bit.
        air: Of the rally.
    """
    v_1 = vel
    a_1 = acceleration(v_1, spin, air)
    v_2 = axpy(0.5 * h, a_1, vel)
    a_2 = acceleration(v_2, spin, air)
    v_3 = axpy(0.5 * h, a_2, vel)
    a_3 = acceleration(v_3, spin, air)
    v_4 = axpy(h, a_3, vel)
    a_4 = acceleration(v_4, spin, air)
    sixth = h / 6.0
    return (
        (
            pos[0] + sixth * (v_1[0] + 2.0 * (v_2[0] + v_3[0]) + v_4[0]),
            pos[1] + sixth * (v_1[1] + 2.0 * (v_2[1] + v_3[1]) + v_4[1]),
            pos[2] + sixth * (v_1[2] + 2.0 * (v_2[2] + v_3[2]) + v_4[2]),
        ),
        (
            vel[0] + sixth * (a_1[0] + 2.0 * (a_2[0] + a_3[0]) + a_4[0]),
            vel[1] + sixth * (a_1[1] + 2.0 * (a_2[1] + a_3[1]) + a_4[1]),
            vel[2] + sixth * (a_1[2] + 2.0 * (a_2[2] + a_3[2]) + a_4[2]),
        ),
    )
