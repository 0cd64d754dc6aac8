"""What a match asked of the robot: whether it struck itself or the table, how fast its joints ran, how it met the ball.

A policy is worth as much as the robot on which it can play. These measures say whether that robot could be built.
"""

from dataclasses import dataclass, fields
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from common.env.rally_env import EnvStep, RallyEnv
from common.physics.chain import racket_state
from common.rally.hit import BALL_POS, FRESH, JOINT_POS, JOINT_VEL
from common.robot.description import describe
from common.task.config import RobotName

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

DEEP: Final = 0.002  # [m] self-penetration from which on a rally counts
STRONG: Final = 50.0  # [N] force on the table from which on a strike counts
RIM: Final = 0.85  # of the racket's radius: a hit beyond it is on the rim
_SATURATED: Final = 0.999  # of a drive's force


@dataclass(frozen=True, slots=True)
class RobotRecord:
    """What the robot did in rallies, one row each, and in all their control steps together."""

    depth: Array  # (n, links) [m] deepest penetration of the robot by a link of its own
    self_force: Array  # (n, links) [N] largest force between a link and the robot
    table_force: Array  # (n, links) [N] largest force between a link and the table
    speed: Array  # (n, 7) largest joint speed over its limit
    saturated: Array  # (n, 7) share of the substeps in which a drive gave its largest force
    clipped: Array  # (n, 7) share of the control steps in which the policy asked for more than the range
    racket_speed: Array  # (n,) [m/s] of the racket's centre at the contact; nan without one
    off_centre: (
        Array  # (n,) distance of the contact from the racket's centre over its radius; nan without one
    )

    def of(self, chosen: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> "RobotRecord":
        """Return the rallies that ``chosen`` marks (n,) or numbers."""
        return RobotRecord(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    @classmethod
    def together(cls, parts: list[Self]) -> Self:
        """Return the rallies of several records as one."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})


class RobotMonitor:
    """Records what the robots of an environment do, rally by rally.

    Args:
        env: It keeps hits (``keeps_hits``).
    """

    def __init__(self, env: RallyEnv) -> None:
        self._env, self._robot = env, env.robot
        self._links = len(self._robot.description.links)
        self._now = self._empty(env.count)
        self._steps = np.zeros(env.count)
        self._ended: list[RobotRecord] = []

    def update(self, actions: Floats, step: EnvStep) -> None:
        """Record a control step, under ``actions`` (B, 7) as the policy gave them, before they were clipped."""
        now, motion, sensors = self._now, self._env.motion, self._robot.sensors
        own, table = sensors.own, sensors.table
        before = np.concatenate([motion.start_pos[:, None], motion.joint_pos[:, :-1]], axis=1)
        speed = np.abs(motion.joint_pos - before) / (motion.step * self._robot.speed_limit)
        saturated = np.abs(motion.torque) >= _SATURATED * self._robot.torque_limit
        np.maximum(now.depth, np.max(-own[..., 3], axis=1), out=now.depth)
        np.maximum(now.self_force, np.linalg.norm(own[..., :3], axis=-1).max(axis=1), out=now.self_force)
        np.maximum(now.table_force, np.linalg.norm(table, axis=-1).max(axis=1), out=now.table_force)
        np.maximum(now.speed, speed.max(axis=1), out=now.speed)
        now.saturated[:] += saturated.mean(axis=1)
        now.clipped[:] += np.abs(actions) > 1.0
        self._steps += 1.0
        self._record_hits()
        rows = step.finished.rows
        if rows.size:
            self._finish(rows, step.finished.validated)

    def record(self) -> RobotRecord:
        """Return the validated rallies that ended."""
        return RobotRecord.together([*self._ended, self._empty(0)])

    def _record_hits(self) -> None:
        hits = self._env.rallies.hit
        for row in np.flatnonzero(hits[:, FRESH] == 1.0):
            hit = hits[row]
            joints = tuple(hit[JOINT_POS : JOINT_POS + 7]), tuple(hit[JOINT_VEL : JOINT_VEL + 7])
            pose, velocity, _ = racket_state(self._robot.chain, *joints)
            offset = hit[BALL_POS : BALL_POS + 3] - np.array(pose.centre)
            self._now.racket_speed[row] = np.linalg.norm(velocity)
            self._now.off_centre[row] = np.hypot(offset @ pose.side, offset @ pose.up) / pose.radius

    def _finish(self, rows: npt.NDArray[np.int64], validated: npt.NDArray[np.bool_]) -> None:
        self._now.saturated[rows] /= self._steps[rows, None]
        self._now.clipped[rows] /= self._steps[rows, None]
        self._ended.append(self._now.of(rows[validated]))
        fresh = self._empty(len(rows))
        for field in fields(RobotRecord):
            getattr(self._now, field.name)[rows] = getattr(fresh, field.name)
        self._steps[rows] = 0.0

    def _empty(self, count: int) -> RobotRecord:
        links = (count, self._links)
        return RobotRecord(
            depth=np.zeros(links),
            self_force=np.zeros(links),
            table_force=np.zeros(links),
            speed=np.zeros((count, 7)),
            saturated=np.zeros((count, 7)),
            clipped=np.zeros((count, 7)),
            racket_speed=np.full(count, np.nan),
            off_centre=np.full(count, np.nan),
        )


def _distribution(values: Array) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not known.size:
        return {"p50": None, "p99": None, "max": None}
    p50, p99, largest = np.quantile(known, (0.5, 0.99, 1.0))
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "max": round(float(largest), 2)}


def robot_measures(record: RobotRecord, links: tuple[str, ...], joints: list[str]) -> dict[str, Any]:
    """Return the measures of the robot by name, ready for JSON.

    Args:
        record: Of a match; at least one rally.
        links: Names of the record's links.
        joints: Names of the joints.
    """

    def by(names: tuple[str, ...] | list[str], values: Array, digits: int = 4) -> dict[str, float]:
        return {name: round(float(value), digits) for name, value in zip(names, values, strict=True)}

    def forces(of: Array) -> dict[str, dict[str, float | None]]:
        return {link: _distribution(of[:, k]) for k, link in enumerate(links)}

    hits = record.off_centre[np.isfinite(record.off_centre)]
    deep = record.depth > DEEP
    return {
        "self_penetration_share": round(float(deep.any(axis=1).mean()), 4),
        "speed_over_limit_max": round(float(record.speed.max()), 3),
        "table_strike_share": round(float((record.table_force > STRONG).any(axis=1).mean()), 4),
        "self_penetration_by_link": by(links, deep.mean(axis=0)),
        "speed_over_limit_by_joint": by(joints, record.speed.max(axis=0), 3),
        "self_force_n": _distribution(record.self_force.max(axis=1)),
        "self_force_n_by_link": forces(record.self_force),
        "table_force_n": _distribution(record.table_force.max(axis=1)),
        "table_force_n_by_link": forces(record.table_force),
        "torque_saturation_by_joint": by(joints, record.saturated.mean(axis=0)),
        "command_clipping_by_joint": by(joints, record.clipped.mean(axis=0)),
        "racket_speed_m_per_s": _distribution(record.racket_speed),
        "rim_hit_share": round(float((hits > RIM).mean()), 4) if hits.size else None,
    }


def robot_part(record: RobotRecord | None, robot: RobotName) -> dict[str, Any]:
    """Return the part ``robot`` of an evaluation: the robot's name and its measures; nothing without a rally."""
    if record is None or not len(record.depth):
        return {}
    about = describe(robot)
    return {
        "robot": {"name": robot} | robot_measures(record, about.links, [joint.name for joint in about.joint])
    }
