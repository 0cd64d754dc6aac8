"""The ball as a free body in MuJoCo, for ``collision: original``: the model, and how robot and ball are stepped.

Contacts need a short time step and are rare. So each grid step of the flight (5 ms) is played in one of two ways. Balls
that may touch an obstacle in it take steps of 0.5 ms, and the air's force is renewed every millisecond. All other balls
take one step of 5 ms. A control step is a few short rollouts, never a loop over environments (ADR-0027).
"""

from typing import Final, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.jit import kernel
from common.physics import touch
from common.physics.chain import Chain, joints_at, racket_pose, speed_bound
from common.physics.constants import BALL_INERTIA, BALL_MASS, BALL_RADIUS, GRAVITY, GRID_STEP, TABLE_FRICTION
from common.physics.flight import acceleration
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, vec_at
from common.robot.chain_of import capsule_names
from common.robot.description import describe
from common.robot.model import robot_xml
from common.task.randomization import air_of

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

# [s] with 1 ms a fast ball touches the racket in a single step, and the restitution depends on chance
STEP = 0.0005
SUBSTEPS = round(GRID_STEP / STEP)  # in a grid step
# Substeps with the same force of the air. If it lasted 5 ms, the force on the incoming ball would act on the ball that
# was hit
AIR_SUBSTEPS = 2
CLEARANCE = 0.002  # [m] for the gap's error at the speeds of a step's start
# [m/s] how much the closing speed may grow in 5 ms: 1.8 m/s with all drives at their force limits, and a margin
SPEEDING_UP = 3.0

# solref's damping also brakes the slip. At 17/s a contact of 3 ms takes only 4 % of the slip. At 100/s it takes a tenth
# to a quarter. On 300 random bounces 100/s adds no energy, 200/s adds up to 14 %, and 300/s more than doubles it. So
# 100/s is the limit of the soft contact with this time step. With 0.25 ms, 200/s would be possible
SLIP_DAMPING: Final = 100.0  # [1/s]


class Surface(NamedTuple):
    """A MuJoCo contact pair's parameters."""

    stiffness: float  # [1/s^2] solref's first number, negated
    damping: float  # [1/s] solref's second number, negated
    friction: float  # [-] sliding


# Spring and cone of the published MuJoCo models of table tennis (solref "-1000000 -17", elliptic, after DeepMind's):
# restitution 0.97 at every speed. The friction is measured on tables; theirs is 0.1
HARD: Final = Surface(1.0e6, 17.0, TABLE_FRICTION)
# The same spring with the damping of our table's mean restitution at 3 m/s: 0.92, and 0.92 at every other speed, where
# the measured law falls from 0.94 to 0.86 between 2 and 6 m/s
TABLE: Final = Surface(1.0e6, 55.0, TABLE_FRICTION)
# A spring that is twice as fast, so that a ball at 30 m/s does not pass the racket. The damping gives inverted rubber's
# restitution at 4.35 m/s, 0.79, at every speed, on average: it scatters by 0.05 with the time in a step at which a
# contact begins, because a contact lasts three steps. The friction is large, so that the contact always sticks. MuJoCo
# can only brake the slip. It can't reverse it as rubber does
RUBBER: Final = Surface(4.0e6, 290.0, 1.0)


class Obstacle(NamedTuple):
    """A geom that the ball can touch."""

    geom: str
    touch: touch.Touch  # what a contact means; for the table it depends on the place
    surface: Surface


RACKET_ROW: Final = 0  # of ``obstacles``


def obstacles(name: str) -> list[Obstacle]:
    """Return what the ball can touch in the model of a robot: racket, surroundings, and the robot's other parts."""
    return [
        Obstacle(describe(name).racket, touch.Touch.RACKET, RUBBER),
        Obstacle("table", touch.Touch.ROBOT_COURT, TABLE),
        Obstacle("net", touch.Touch.NET, HARD),
        Obstacle("floor", touch.Touch.FLOOR, HARD),
        *(Obstacle(geom, touch.Touch.BODY, HARD) for geom in capsule_names(name)),
    ]


BALL_POS, BALL_QUAT, BALL_VEL, BALL_SPIN = 7, 10, 7, 10  # first columns in qpos and qvel
_PARKED = (5.0, 0.0, -0.7, 1.0, 0.0, 0.0, 0.0)  # out of play: a failure of the simulation ends the rally


def load_model(name: str) -> mujoco.MjModel:
    """Return the compiled robot with the ball: a free body after the robot's seven joints."""
    spec = mujoco.MjSpec.from_string(robot_xml(name))
    spec.option.timestep = STEP
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    ball = spec.worldbody.add_body(name="ball")
    ball.add_freejoint()
    ball.mass, ball.inertia, ball.explicitinertial = BALL_MASS, [BALL_INERTIA] * 3, True
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_RADIUS, 0.0, 0.0],
        contype=0,  # contacts by explicit pairs only
        conaffinity=0,
    )
    for geom, _, surface in obstacles(name):
        spec.add_pair(
            name=f"ball on {geom}",
            geomname1="ball",
            geomname2=geom,
            condim=3,
            solref=[-surface.stiffness, -surface.damping],
            solreffriction=[-1.0, -SLIP_DAMPING],
            friction=[surface.friction, surface.friction, 0.0, 0.0, 0.0],
        )
        spec.add_sensor(
            name=f"ball on {geom}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname="ball",
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=geom,
            intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],
        )
    home = spec.keys[0]
    home.qpos = np.concatenate([home.qpos, _PARKED])
    return spec.compile()


@kernel
def to_world(quaternion: Array, a: Vec) -> Vec:
    """Return a body's vector in the world frame, from the body's quaternion (w, x, y, z)."""
    u = (quaternion[1], quaternion[2], quaternion[3])
    t = scale(2.0, cross(u, a))
    return add(axpy(quaternion[0], t, a), cross(u, t))


@kernel
def _write_air_force(
    qpos: Array, qvel: Array, parameters: Array, rows: Rows, model: int, force: Array
) -> None:
    """Write the air's force [N] on the balls of ``rows`` into their rows of ``force`` (B, 6)."""
    for b in rows:
        spin = to_world(qpos[b, BALL_QUAT:], vec_at(qvel[b], BALL_SPIN))
        a = acceleration(vec_at(qvel[b], BALL_VEL), spin, air_of(parameters[b], model))
        force[b, 0], force[b, 1] = BALL_MASS * a[0], BALL_MASS * a[1]
        force[b, 2] = BALL_MASS * (a[2] + GRAVITY)  # MuJoCo adds gravity


@kernel
def _closes(gap: float, normal: Vec, vel: Vec, robot_speed: float) -> bool:
    """Return whether a gap may close within a grid step.

    The gap to a convex obstacle is a convex function of the ball's position. So it closes no faster than the velocity
    along the present normal.
    """
    closing = max(robot_speed - dot(normal, vel), 0.0) + SPEEDING_UP
    return gap < CLEARANCE + GRID_STEP * closing


@kernel
def _within_reach(chain: Chain, qpos: Array, qvel: Array, path: Array, out: Flags) -> None:
    """Write which balls may touch an obstacle within a grid step.

    Args:
        chain: Of the robots.
        qpos: Positions (B, 14).
        qvel: Velocities (B, 13).
        path: Scratch (2, 7).
        out: (B,); written.
    """
    no_normal = (0.0, 0.0, 0.0)
    for b in range(qpos.shape[0]):
        pos, vel = vec_at(qpos[b], BALL_POS), vec_at(qvel[b], BALL_VEL)
        table, on_table = touch.table_gap(pos)
        net, on_net = touch.net_gap(pos)
        floor, on_floor = touch.floor_gap(pos)
        out[b] = (
            _closes(table, on_table, vel, 0.0)
            or _closes(net, on_net, vel, 0.0)
            or _closes(floor, on_floor, vel, 0.0)
        )
        if out[b]:
            continue
        for j in range(7):
            path[0, j], path[1, j] = qpos[b, j], qpos[b, j] + GRID_STEP * qvel[b, j]
        speed = speed_bound(chain, path, GRID_STEP)
        q = joints_at(path, 0.0, GRID_STEP)
        anywhere = norm(vel) + speed  # the arm is not convex: the direction does not count
        if not _closes(touch.robot_gap_bound(pos, chain, q), no_normal, vel, anywhere):
            continue
        racket, on_racket = touch.racket_gap(pos, racket_pose(chain, q))
        body = touch.body_gap(pos, chain, q)[0]
        out[b] = _closes(racket, on_racket, vel, speed) or _closes(body, no_normal, vel, anywhere)


def _line(start: Array, end: Array) -> Array:
    """Return records (n, SUBSTEPS, ...) on the straight line from ``start`` to ``end`` (n, ...)."""
    share = np.arange(1, SUBSTEPS + 1).reshape(-1, *[1] * (start.ndim - 1)) / SUBSTEPS
    line: Array = start[:, None] + share * (end - start)[:, None]
    return line


class RobotAndBall(RobotBatch):
    """B simulations of robot and ball.

    Args:
        count: B.
        name: Of the robot.
        control_rate_hz: Control steps a second.
        flight_model: ``flight.SIMPLE`` or ``flight.FULL``.
        threads: MuJoCo threads.
    """

    def __init__(
        self, count: int, name: str, control_rate_hz: float, flight_model: int, threads: int = 1
    ) -> None:
        super().__init__(count, name, control_rate_hz, STEP, threads, load_model(name))
        self.ball_force: Array = self._wrench[:, self.model.body("ball").id]
        self.qpos: Array = self.batch.bind("qpos")
        self.qvel: Array = self.batch.bind("qvel")
        self.parameters: Array = np.ones((count, 2))  # factors of drag and lift
        self._flight_model = flight_model
        self._time_step: Array = self.batch.expand("opt.timestep")
        self._is_near = np.zeros(count, np.bool_)
        self._path = np.empty((2, 7))

    @property
    def records(self) -> dict[str, Array]:
        """The last control step's records by MuJoCo field (B, substeps, ...)."""
        return self._records

    def place(self, rows: Rows, ball: Array) -> None:
        """Put balls ``rows`` in flight with position, velocity and spin (n, 9)."""
        self.qpos[rows, BALL_POS:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        self.qpos[rows, BALL_POS:BALL_QUAT] = ball[:, :3]
        self.qvel[rows, BALL_VEL:] = ball[:, 3:]  # not rotated: the ball's frame is the world's

    def _advance(self, control: Array) -> dict[str, Array]:
        for first in range(0, self.substeps, SUBSTEPS):
            _within_reach(self.chain, self.qpos, self.qvel, self._path, self._is_near)
            whole = slice(first, first + SUBSTEPS)
            near, far = np.flatnonzero(self._is_near), np.flatnonzero(~self._is_near)
            for k in range(first, whole.stop if near.size else first, AIR_SUBSTEPS):
                piece = slice(k, k + AIR_SUBSTEPS)
                self._record(near, piece, self._roll_out(near, STEP, control[near, piece]))
            if far.size:
                self._record(
                    far, whole, self._long_step(far, control[far, whole].mean(axis=1, keepdims=True))
                )
        return self._records

    def _roll_out(self, rows: Rows, step: float, control: Array) -> dict[str, Array]:
        """Return records (n, m, ...) of MuJoCo's steps of ``step`` seconds under joint targets (n, m, 7)."""
        _write_air_force(self.qpos, self.qvel, self.parameters, rows, self._flight_model, self.ball_force)
        self._time_step[rows] = step
        played: dict[str, Array] = self.batch.rollout(
            control.shape[1],
            control=control,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=("qpos", "qvel", "actuator_force", "sensordata"),
            ids=rows,
        )
        return played

    def _long_step(self, rows: Rows, control: Array) -> dict[str, Array]:
        """Return records (n, SUBSTEPS, ...) of one long step under joint targets (n, 1, 7): poses on a line."""
        start = {"qpos": self.qpos[rows], "qvel": self.qvel[rows]}
        played = self._roll_out(rows, GRID_STEP, control)
        # MuJoCo moves the ball by the velocity at the step's end: an acceleration a moves it a h^2 / 2 too far
        ahead = 0.5 * GRID_STEP**2 * (self.ball_force[rows, :3] / BALL_MASS - (0.0, 0.0, GRAVITY))
        played["qpos"][:, 0, BALL_POS:BALL_QUAT] -= ahead
        self.qpos[rows, BALL_POS:BALL_QUAT] -= ahead
        return {
            field: _line(start[field], values[:, 0])
            if field in start
            else np.repeat(values, SUBSTEPS, axis=1)
            for field, values in played.items()
        }

    def _record(self, rows: Rows, part: slice, played: dict[str, Array]) -> None:
        for field, values in played.items():
            if field not in self._records:
                shape = (self.count, self.substeps, *values.shape[2:])
                self._records[field] = np.empty(shape, values.dtype)
            self._records[field][rows, part] = values
