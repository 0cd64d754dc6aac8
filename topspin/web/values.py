"""Everything that a rally of one ball is computed from, as a block of bytes for a program that is no Python.

The block begins with a table of one row per value: the bytes from the block's start to it, and its shape. The values
follow. Names, order, types and shapes all come from the named tuples that the kernels take, so a new field of one of
them needs no word here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from common.env.robot import RobotBatch
from common.perception.flight_track import new_tracks
from common.physics.chain import JOINTS
from common.rally.observe import ObservationFlags, observation_flags
from common.rally.state import Array, Integers, Rallies, RobotMotion, Rules, Step, allocate
from common.task.config import TaskConfig
from common.task.launch import LAUNCH_SIZE
from common.task.observation import policy_layout, size
from common.task.randomization import RandomizationProfile, profile_of
from common.task.reward import reward_table
from common.task.states import transition_table

COLUMNS: Final = 4  # of the table: bytes from the block's start, and the shape, with ones after it
ROUNDS: Final = 2  # as in films: a ball that has landed flies on to its next touch
_STAGE: Final = 3  # of the reward, which a page does not show
_ALIGNED: Final = 8  # [bytes]


class Values(NamedTuple):
    """What begins a rally, observes it, and plays it on by a control step. B = 1 everywhere."""

    rallies: Rallies
    motion: RobotMotion
    rules: Rules
    profile: RandomizationProfile
    step: Step
    flags: ObservationFlags
    rows: Integers  # (1,) 0: the one ball
    launch: Array  # (1, 12)
    seed: npt.NDArray[np.uint64]  # (1,)
    spread: float  # [m, rad] of the start pose
    gains: Array  # (1, 3, 7) factors of kp, kv and damping; drawn by ``entry.begin``
    offset: Array  # (1, 7) [m, rad] start pose minus home; drawn by ``entry.begin``
    joint_pos: Array  # (1, 7) [m, rad] now
    joint_vel: Array  # (1, 7) [m/s, rad/s]
    actions: Array  # (1, 7)
    obs: npt.NDArray[np.float32]  # (1, D)


@dataclass(frozen=True, slots=True)
class Block:
    """Values as bytes, and where they are."""

    content: bytes
    places: dict[str, tuple[str, int, int]]  # of each value by its name: NumPy's type, first byte, count


def values_of(task: TaskConfig, robot: RobotBatch) -> Values:
    """Return the values of a task before its first ball.

    Args:
        task: With collision ``tailored``.
        robot: The task's robot.
    """
    options, reward = task.observation, task.reward
    rallies, step = allocate(
        1,
        options.history,
        has_camera=task.perception == "full",
        tracks=new_tracks(1 if options.is_tracked else 0, options.expected_spin),
    )
    rallies.rounds_left[:] = ROUNDS
    substeps = robot.substeps
    return Values(
        rallies=rallies,
        motion=RobotMotion(
            start_pos=np.zeros((1, JOINTS)),
            joint_pos=np.zeros((1, substeps, JOINTS)),
            torque=np.zeros((1, substeps, JOINTS)),
            contact=np.zeros((1, substeps, 0)),
            step=robot.step_s,
        ),
        rules=Rules(
            transitions=transition_table(),
            rewards=np.ascontiguousarray(reward_table()[_STAGE - 1]),
            landing_scale=reward.landing_scale,
            landing_bonus=0.0,
            landing_bonus_scale=reward.landing_bonus_scale,
            rate_scale=1.0,
            torque_weight=0.0,
            torque_limit=robot.torque_limit,
            jitter_weight=0.0,
            collision_weight=0.0,
            grid_steps=task.grid_steps,
            time_limit=task.time_limit_s,
            flight_model=int(task.flight_model),
            chain=robot.chain,
        ),
        profile=profile_of(task.randomization, task.rubber),
        step=step,
        flags=observation_flags(options)._replace(is_privileged=False),
        rows=np.zeros(1, np.int64),
        launch=np.zeros((1, LAUNCH_SIZE)),
        seed=np.zeros(1, np.uint64),
        spread=task.reset_spread,
        gains=np.zeros((1, 3, JOINTS)),
        offset=np.zeros((1, JOINTS)),
        joint_pos=np.zeros((1, JOINTS)),
        joint_vel=np.zeros((1, JOINTS)),
        actions=np.zeros((1, JOINTS)),
        obs=np.zeros((1, size(policy_layout(options))), np.float32),
    )


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield arrays and numbers of nested tuples, with names such as ``rallies.ball``. A number becomes an array ()."""
    if isinstance(value, tuple):
        names = getattr(value, "_fields", range(len(value)))
        for part, inner in zip(names, value, strict=True):
            yield from leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, np.asarray(value, None if isinstance(value, np.ndarray) else _number_type(value))


def _number_type(value: float) -> type[np.generic]:
    return np.float64 if isinstance(value, float) else np.int64  # a bool too


def expression(value: Any, rows: Iterator[int]) -> str:
    """Return the text that reads ``value`` in a kernel, from ``table`` and the block's ``address``.

    Args:
        value: Nested tuples, as for ``leaves``.
        rows: Numbers of the table's rows.
    """
    if isinstance(value, tuple):
        inner = ", ".join(expression(part, rows) for part in value)
        return f"{type(value).__name__ if hasattr(value, '_fields') else ''}({inner},)"
    row = next(rows)
    place = f"pointer(address + table[{row}, 0])"
    if isinstance(value, np.ndarray):
        shape = "".join(f"table[{row}, {1 + axis}], " for axis in range(value.ndim))
        return f"carray({place}, ({shape}), {value.dtype})"
    number = f"carray({place}, (1,), {np.dtype(_number_type(value))})[0]"
    return f"{number} != 0" if isinstance(value, bool) else number


def packed(values: Values) -> Block:
    """Return values as a block."""
    found = list(leaves(values))
    at = len(found) * COLUMNS * 8
    table, places, contents = [], {}, []
    for name, array in found:
        table.append([at, *array.shape, *[1] * (COLUMNS - 1 - array.ndim)])
        places[name] = str(array.dtype), at, array.size
        content = np.ascontiguousarray(array).tobytes()
        contents.append(content.ljust(-(-len(content) // _ALIGNED) * _ALIGNED, b"\0"))
        at += len(contents[-1])
    return Block(b"".join(chain([np.array(table, np.int64).tobytes()], contents)), places)
