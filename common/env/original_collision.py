"""``collision: original``: the ball as a free body in MuJoCo, bouncing by the simulator's own contacts.

For comparison with the tailored collisions (the paper's Policy 3). Rules, reward, noise of camera and drives, and
the air are the same; restitution and friction are MuJoCo's and don't vary from rally to rally. The air's force is
the tailored flight's acceleration, held in between: a control step is a few short rollouts, never a loop over
environments. Contacts need a short time step, and are rare: on each piece of the flight's grid (5 ms) balls with an
obstacle within reach are stepped finely, the air's force renewed every millisecond, and the others take it in one step.

A touch is the first substep in which MuJoCo reports a contact with an obstacle that the ball was free of. MuJoCo's
contacts are springs: one lasts some substeps, and the ball sinks in by up to 0.45 mm per m/s at the racket. The
racket's half thickness and the ball's radius together are 26.5 mm, so that nothing passes below 50 m/s.
"""

from typing import Final, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from common.env.robot import MODEL_PATH, RobotBatch, RobotPreset, limit_speeds
from common.jit import kernel
from common.physics import touch
from common.physics.arm import (
    joint_rates_at,
    joints_at,
    point_velocity,
    racket_motion,
    racket_pose,
    speed_bound,
)
from common.physics.constants import BALL_INERTIA, BALL_MASS, BALL_RADIUS, GRAVITY, GRID_STEP, TABLE_FRICTION
from common.physics.flight import acceleration
from common.physics.vec import Vec, add, axpy, cross, dot, norm, scale, vec_at
from common.rally import play
from common.rally.hindsight import BOUNCE, FRESH, note_hit, note_leaving
from common.rally.noise import NoiseProfile
from common.rally.trajectory import State

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

STEP = 0.0005  # [s] at 1 ms a fast ball meets the racket in a single step, and its restitution is chance
SUBSTEPS = round(GRID_STEP / STEP)  # of a piece of the grid
AIR_SUBSTEPS = (
    2  # that the air's force is held for; for 5 ms, a hit ball would be drawn by the air that met it
)
CLEARANCE = 0.010  # [m] MuJoCo's beam has corners, 8 mm beyond ours
SPEEDING_UP = 3.0  # [m/s] by which they close faster than now over 5 ms: 1.8 with all drives at their limits
FREE_SUBSTEPS = 4  # a contact that reopens within 2 ms is still the same one


# MuJoCo brakes a contact's slip by solref's damping too, and 17/s in 3 ms is friction in name only (4 % of the
# slip). 100/s takes a tenth to a quarter; on 300 random bounces it adds no energy, where 200/s adds up to 14 % and
# 300/s more than doubles it (at 0.25 ms 200/s would do): the soft contact's limit at this step
SLIP_DAMPING: Final = 100.0  # [1/s]


class Surface(NamedTuple):
    """A MuJoCo contact pair's parameters."""

    stiffness: float  # [1/s^2] solref's first number, negated
    damping: float  # [1/s] solref's second number, negated
    friction: float  # [-] sliding


# Spring and cone of the published MuJoCo models of table tennis (solref "-1000000 -17", elliptic, after
# DeepMind's): e = 0.97 for a ball that falls straight. Friction as measured on tables; theirs is 0.1
HARD: Final = Surface(1.0e6, 17.0, TABLE_FRICTION)
# Ours: twice as fast a spring, so that 30 m/s don't pass a racket; damped to e = 0.85 at 2-10 m/s, as inverted
# rubber at 2 m/s; a friction that never lets go. MuJoCo only brakes the slip, it can't turn it round as rubber does
RUBBER: Final = Surface(4.0e6, 280.0, 1.0)

# Geom, what touching it is (for the table: by place), and its surface
OBSTACLES: Final[tuple[tuple[str, touch.Touch, Surface], ...]] = (
    ("racket", touch.Touch.RACKET, RUBBER),
    ("table", touch.Touch.ROBOT_COURT, HARD),
    ("net", touch.Touch.NET, HARD),
    ("floor", touch.Touch.FLOOR, HARD),
    ("upper_arm", touch.Touch.BODY, HARD),
    ("forearm", touch.Touch.BODY, HARD),
    ("wrist", touch.Touch.BODY, HARD),
    ("handle", touch.Touch.BODY, HARD),
    ("column", touch.Touch.BODY, HARD),
    ("beam", touch.Touch.BODY, HARD),
)
# Touch sensors of the robot that feel the ball too, as (sensor, obstacle): the penalty F_c leaves the ball out
_FELT: Final = ((0, 4), (1, 5), (2, 6), (3, 0), (3, 7))
_RACKET_ROW = 0  # of OBSTACLES
_TOUCHES = tuple(int(what) for _, what, _ in OBSTACLES)
_ROBOT_SENSORS = 4
_BALL_POS, _BALL_TURN, _BALL_VEL, _BALL_SPIN = 7, 10, 7, 10  # where they begin in qpos and qvel
_PARKED = (5.0, 0.0, -0.7, 1.0, 0.0, 0.0, 0.0)  # out of play: a fault of the simulation ends the rally

_TAU_1, _TAU_2, _TAU_3 = int(State.TAU_1), int(State.TAU_2), int(State.TAU_3)
_TAU_23 = int(State.TAU_23)
_RACKET, _TABLE, _OUT = int(touch.RACKET), int(touch.ROBOT_COURT), int(touch.OUT)


def load_model(preset: RobotPreset) -> mujoco.MjModel:
    """Return the compiled robot with the ball: a free body after the robot's seven joints."""
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    spec.option.timestep = STEP
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    ball = spec.worldbody.add_body(name="ball")
    ball.add_freejoint()
    ball.mass, ball.inertia, ball.explicitinertial = BALL_MASS, [BALL_INERTIA] * 3, True
    ball.add_geom(
        name="ball",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_RADIUS, 0.0, 0.0],
        contype=0,  # by explicit pairs only
        conaffinity=0,
    )
    for geom, _, surface in OBSTACLES:
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
    model = spec.compile()
    limit_speeds(model, preset)
    return model


@kernel
def _turned(turn: Array, a: Vec) -> Vec:
    """Return a body's vector in the world, by the body's quaternion (w, x, y, z)."""
    u = (turn[1], turn[2], turn[3])
    t = scale(2.0, cross(u, a))
    return add(axpy(turn[0], t, a), cross(u, t))


@kernel
def _blow(qpos: Array, qvel: Array, condition: Array, rows: Rows, model: int, force: Array) -> None:
    """Write the air's force [N] on the balls of ``rows`` into theirs of (B, 6)."""
    for b in rows:
        spin = _turned(qpos[b, _BALL_TURN:], vec_at(qvel[b], _BALL_SPIN))
        a = acceleration(vec_at(qvel[b], _BALL_VEL), spin, condition[b, 0], condition[b, 1], model)
        force[b, 0], force[b, 1] = BALL_MASS * a[0], BALL_MASS * a[1]
        force[b, 2] = BALL_MASS * (a[2] + GRAVITY)  # gravity is MuJoCo's


@kernel
def _closes(gap: float, normal: Vec, vel: Vec, robot_speed: float) -> bool:
    """Return whether a gap may close before the grid's next point.

    To something convex it is a convex function of the ball's position: it grows by no less than its slope says.
    """
    closing = max(robot_speed - dot(normal, vel), 0.0) + SPEEDING_UP
    return gap < CLEARANCE + GRID_STEP * closing


@kernel
def _within_reach(qpos: Array, qvel: Array, path: Array, out: Flags) -> None:
    """Write which balls may touch something before the grid's next point.

    Args:
        qpos: Positions (B, 14).
        qvel: Velocities (B, 13).
        path: Scratch (2, 7).
        out: (B,); written.
    """
    no_normal = (0.0, 0.0, 0.0)
    for b in range(qpos.shape[0]):
        pos, vel = vec_at(qpos[b], _BALL_POS), vec_at(qvel[b], _BALL_VEL)
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
        speed = speed_bound(path, GRID_STEP)
        q = joints_at(path, 0.0, GRID_STEP)
        anywhere = norm(vel) + speed  # no slope to go by: the arm isn't convex
        if not _closes(touch.robot_gap_bound(pos, q), no_normal, vel, anywhere):
            continue
        racket, on_racket = touch.racket_gap(pos, racket_pose(q))
        body = touch.body_gap(pos, q)[0]
        out[b] = _closes(racket, on_racket, vel, speed) or _closes(body, no_normal, vel, anywhere)


def _line(start: Array, end: Array) -> Array:
    """Return ``SUBSTEPS`` records (n, SUBSTEPS, ...) on the straight line from ``start`` to ``end`` (n, ...)."""
    share = np.arange(1, SUBSTEPS + 1).reshape(-1, *[1] * (start.ndim - 1)) / SUBSTEPS
    line: Array = start[:, None] + share * (end - start)[:, None]
    return line


class RobotAndBall(RobotBatch):
    """B simulations of robot and ball.

    Args:
        count: B.
        preset: See ``robot.load_model``.
        control_rate_hz: Control steps a second.
        flight_model: ``flight.SIMPLE`` or ``flight.FULL``.
        threads: MuJoCo threads.
    """

    def __init__(
        self, count: int, preset: RobotPreset, control_rate_hz: float, flight_model: int, threads: int = 1
    ) -> None:
        super().__init__(count, preset, control_rate_hz, STEP, threads, load_model(preset))
        self.ball_force: Array = self._wrench[:, self.model.body("ball").id]
        self.qpos: Array = self.batch.bind("qpos")
        self.qvel: Array = self.batch.bind("qvel")
        self.condition: Array = np.ones((count, 2))  # factors of drag and lift
        self._flight_model = flight_model
        self._time_step: Array = self.batch.expand("opt.timestep")
        self._is_near = np.zeros(count, np.bool_)
        self._path = np.empty((2, 7))

    @property
    def records(self) -> dict[str, Array]:
        """The last control step's records by MuJoCo field (B, substeps, ...)."""
        return self._records

    def place(self, rows: Rows, ball: Array) -> None:
        """Put balls ``rows`` in flight: position, velocity, spin (n, 9)."""
        self.qpos[rows, _BALL_POS:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        self.qpos[rows, _BALL_POS:_BALL_TURN] = ball[:, :3]
        self.qvel[rows, _BALL_VEL:] = ball[:, 3:]  # unturned, so that its own frame is the world's

    def _advance(self, control: Array) -> dict[str, Array]:
        for first in range(0, self.substeps, SUBSTEPS):
            _within_reach(self.qpos, self.qvel, self._path, self._is_near)
            part = slice(first, first + SUBSTEPS)
            near, far = np.flatnonzero(self._is_near), np.flatnonzero(~self._is_near)
            for k in range(first, part.stop if near.size else first, AIR_SUBSTEPS):
                piece = slice(k, k + AIR_SUBSTEPS)
                self._record(near, piece, self._roll_out(near, STEP, control[near, piece]))
            if far.size:
                self._record(far, part, self._stride(far, control[far, part].mean(axis=1, keepdims=True)))
        return self._records

    def _roll_out(self, rows: Rows, step: float, control: Array) -> dict[str, Array]:
        """Return records (n, m, ...) of MuJoCo's steps of ``step`` seconds in this air, under controls (n, m, 7)."""
        _blow(self.qpos, self.qvel, self.condition, rows, self._flight_model, self.ball_force)
        self._time_step[rows] = step
        played: dict[str, Array] = self.batch.rollout(
            control.shape[1],
            control=control,
            control_spec=int(mujoco.mjtState.mjSTATE_CTRL),
            record=("qpos", "qvel", "actuator_force", "sensordata"),
            ids=rows,
        )
        return played

    def _stride(self, rows: Rows, control: Array) -> dict[str, Array]:
        """Return records of one step to the grid's next point, under controls (n, 1, 7), as of fine ones: on a line."""
        start = {"qpos": self.qpos[rows], "qvel": self.qvel[rows]}
        played = self._roll_out(rows, GRID_STEP, control)
        # MuJoCo moves by the velocity at a step's end: under an acceleration a it is ahead by a h^2 / 2
        ahead = 0.5 * GRID_STEP**2 * (self.ball_force[rows, :3] / BALL_MASS - (0.0, 0.0, GRAVITY))
        played["qpos"][:, 0, _BALL_POS:_BALL_TURN] -= ahead
        self.qpos[rows, _BALL_POS:_BALL_TURN] -= ahead
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


@kernel
def _follow(
    rallies: play.Rallies,
    b: int,
    qpos: Array,
    qvel: Array,
    found: Array,
    free: Rows,
    motion: play.Motion,
    rules: play.Rules,
    noise: NoiseProfile,
    path: Array,
) -> play.Flown:
    """Follow ball b through MuJoCo's records of one control step, and judge each touch.

    Args:
        rallies: Row b is written.
        b: Row.
        qpos: Recorded positions (n, 14).
        qvel: Recorded velocities (n, 13).
        found: Contacts with each of OBSTACLES before each substep (n, obstacles).
        free: Substeps since the last contact with each obstacle; written.
        motion: The robots' motion.
        rules: The rules.
        noise: The profile.
        path: Robot b's joint positions (n + 1, 7).
    """
    ball = rallies.ball[b]
    pos, vel, spin = (ball[0], ball[1], ball[2]), (ball[3], ball[4], ball[5]), (ball[6], ball[7], ball[8])
    state, outcome = rallies.state[b], 0
    bounced, hit, landed = False, False, False
    racket_speed = 0.0
    is_pressed = False  # by this control step's hit; one that outlasts the step is not reviewed
    per_grid_step = qpos.shape[0] // rules.grid_steps
    filmed, reviewed = rallies.eyes.shape[0] > 0, rallies.hit.shape[0] > 0
    if reviewed:
        rallies.hit[b, FRESH] = 0.0
    for k in range(qpos.shape[0]):
        since_launch = rallies.clock[b] * GRID_STEP + (k % per_grid_step) * motion.step
        for obstacle in range(found.shape[1]):
            is_new = found[k, obstacle] > 0.0 and free[obstacle] > FREE_SUBSTEPS
            free[obstacle] = 0 if found[k, obstacle] > 0.0 else free[obstacle] + 1
            if not is_new or outcome != 0:
                continue
            what = _TOUCHES[obstacle]
            if what == _TABLE:
                what = touch.table_touch(pos)
            elif what == _RACKET and state != _TAU_2:
                moment = k * motion.step
                joints = joints_at(path, moment, motion.step)
                pose = racket_pose(joints)
                rates = joint_rates_at(path, moment, motion.step)
                racket_vel, racket_spin = racket_motion(joints, rates)
                contact = axpy(-BALL_RADIUS, touch.racket_gap(pos, pose)[1], pos)
                surface_vel = point_velocity(pose.centre, racket_vel, racket_spin, contact)
                racket_speed = min(max(surface_vel[0], 0.0), play.MAX_SPEED_REWARDED)
                if reviewed and rules.transitions[state, _RACKET] == _TAU_2:
                    now = rallies.clock[b] // rules.grid_steps
                    note_hit(rallies.hit[b], pos, vel, spin, joints, rates, moment, now, since_launch)
                    is_pressed = True
            state, outcome = play.judge(rallies, b, state, what, pos, rules)
            if reviewed and state == _TAU_1:
                rallies.hit[b, BOUNCE] = since_launch
        if outcome == 0:
            p, v, w = qpos[k, _BALL_POS:], qvel[k, _BALL_VEL:], qvel[k, _BALL_SPIN:]
            p0, v0 = pos, vel
            pos, vel = (p[0], p[1], p[2]), (v[0], v[1], v[2])
            if filmed:
                play.shoot(
                    rallies, b, noise, (k % per_grid_step) * motion.step, p0, v0, motion.step, pos, vel
                )
            spin = _turned(qpos[k, _BALL_TURN:], (w[0], w[1], w[2]))
            if is_pressed and free[_RACKET_ROW] > 0:
                note_leaving(rallies.hit[b], pos, vel, spin)
                is_pressed = False
            if abs(pos[0]) > touch.PLAY_X or abs(pos[1]) > touch.PLAY_Y:
                state, outcome = play.judge(rallies, b, state, _OUT, pos, rules)
            if state in (_TAU_2, _TAU_23) and pos[0] > BALL_RADIUS:
                rallies.over[b] = True
        bounced, hit, landed = bounced or state == _TAU_1, hit or state == _TAU_2, landed or state == _TAU_3
        if outcome != 0 or (k + 1) % per_grid_step == 0:
            play.film(rallies, b, pos, vel, state)
        if outcome != 0:
            break
    return play.Flown(pos, vel, spin, state, outcome, bounced, hit, landed, racket_speed)


@kernel
def _play_records(
    rallies: play.Rallies,
    motion: play.Motion,
    qpos: Array,
    qvel: Array,
    found: Array,
    free: Rows,
    actions: Array,
    rules: play.Rules,
    noise: NoiseProfile,
    step: play.Step,
) -> None:
    """Judge, pay and film what MuJoCo recorded of every ball in one control step."""
    path = np.empty((motion.joint_pos.shape[1] + 1, 7))
    for b in range(rallies.state.shape[0]):
        play.copy_path(motion, b, path)
        for k in range(found.shape[1]):
            for sensor, obstacle in _FELT:
                if found[b, k, obstacle] > 0.0:
                    motion.contact[b, k, sensor] = 0.0
        flown = _follow(rallies, b, qpos[b], qvel[b], found[b], free[b], motion, rules, noise, path)
        play.settle(rallies, b, flown, motion, actions, rules, noise, path, step)


class OriginalCollision:
    """The ball bounces by MuJoCo's contacts."""

    def __init__(self, robot: RobotAndBall) -> None:
        self.robot: RobotBatch = robot
        self._simulation = robot
        self._free = np.zeros((robot.count, len(OBSTACLES)), np.int64)

    def launch(self, rallies: play.Rallies, rows: Rows) -> None:
        """Put the rallies' balls into the simulation."""
        self._simulation.place(rows, rallies.ball[rows])
        self._simulation.condition[rows] = rallies.condition[rows, :2]
        self._free[rows] = FREE_SUBSTEPS + 1

    def step(
        self, rallies: play.Rallies, actions: Array, rules: play.Rules, noise: NoiseProfile, step: play.Step
    ) -> None:
        """Play one control step; the ball pushes the racket in MuJoCo itself."""
        motion = self._simulation.step(actions)
        records = self._simulation.records
        robot_motion = self.motion = motion._replace(
            joint_pos=records["qpos"][:, :, :7], contact=records["sensordata"][:, :, :_ROBOT_SENSORS]
        )
        found = records["sensordata"][:, :, _ROBOT_SENSORS:]
        _play_records(
            rallies,
            robot_motion,
            records["qpos"],
            records["qvel"],
            found,
            self._free,
            actions,
            rules,
            noise,
            step,
        )
