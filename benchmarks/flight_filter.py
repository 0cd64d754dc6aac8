"""Accuracy of the flight filter: the ball now, its spin, and its predicted interception.

    python -m benchmarks.flight_filter --json

Balls fly past a robot that stands still. At every control step the filter's estimates from the ball's samples are
compared with the truth: position, velocity and spin now, and the ball 0.12 s after its bounce.
"""

import json
import sys
from collections.abc import Mapping
from threading import Event

import numpy as np
import numpy.typing as npt
from pydantic import Field

from benchmarks.env import MemoryRallies
from benchmarks.settings import BenchmarkConfig, run
from common.env.rally_env import RallyEnv
from common.perception.flight_filter import INTERCEPTION_AFTER
from common.perception.flight_track import INTERCEPTION, PRESENT, SPIN
from common.physics.constants import GRID_STEP
from common.physics.flight import FULL, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.rally.state import SAMPLE
from common.task.config import PresetName, Randomization, TaskConfig
from common.task.experience import MATCH
from common.task.launch import KIND, LONGEST_FLIGHT, RallyBlock, draw_rallies
from common.task.launch_presets import SERVE
from common.task.observation import ExpectedSpin
from common.task.randomization import RallyParameter, air_of
from common.task.states import State

Array = npt.NDArray[np.float64]

STEPS = 40  # control steps: 0.8 s
MOMENTS_MS = (-300, -200, -100, -40, 0, 40, 80, 120, 200)  # since the bounce, to the nearest control step
FEWEST = 50  # balls: a moment with fewer is not reported


def truth(block: RallyBlock, parameters: Array) -> tuple[Array, Array]:
    """Return when each ball bounces (n,) [s], and position, velocity and spin at its interception (n, 9)."""
    bounce, interception = np.empty(len(block.seeds)), np.empty((len(block.seeds), 9))
    for k, (launch, rally) in enumerate(zip(block.launches, parameters, strict=True)):
        pos, vel, spin = tuple(launch[:3]), tuple(launch[3:6]), tuple(launch[6:9])
        air = air_of(rally, FULL)
        restitution, friction = rally[[RallyParameter.TABLE_RESTITUTION0, RallyParameter.TABLE_FRICTION]]
        bounce[k] = 0.0
        for _ in range(2 if launch[KIND] == SERVE else 1):
            pos, vel, flown, _, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, air, NO_ROBOT)
            vel, spin = table_bounce(vel, spin, normal, restitution, friction)
            bounce[k] += flown
        for _ in range(round(INTERCEPTION_AFTER / GRID_STEP)):
            pos, vel = flight_step(pos, vel, spin, GRID_STEP, air)
        interception[k] = [*pos, *vel, *spin]
    return bounce, interception


def compare(
    balls: int, launch: PresetName, randomization: Randomization, seed: int, expected: ExpectedSpin = "mild"
) -> dict[int, Array]:
    """Return errors by moment since the bounce [ms].

    Columns: present (6), interception (6), spin (3), and the sample itself (6).
    """
    task = TaskConfig.model_validate(
        {"launch": launch, "randomization": randomization, "observation": {"expected_spin": expected}}
    )
    block = draw_rallies(balls, task, seed=seed)
    env = RallyEnv(balls, task, MemoryRallies(block), experience=MATCH)
    env.reset()
    rallies, hold = env.rallies, np.tile(env.home_action, (balls, 1))
    bounce, interception = truth(block, rallies.parameters)
    found: dict[int, list[Array]] = {moment: [] for moment in MOMENTS_MS}
    in_play = np.ones(balls, np.bool_)
    for _ in range(STEPS):
        in_play[env.step(hold).ended] = False
        since = 20 * np.rint((rallies.clock * GRID_STEP - bounce) / 0.020)
        sample, track, ball = rallies.measurement[:, : SAMPLE - 1], rallies.track, rallies.ball
        errors = np.concatenate(
            (
                track[:, PRESENT : PRESENT + 6] - ball[:, :6],
                track[:, INTERCEPTION + 1 : INTERCEPTION + 7] - interception[:, :6],
                track[:, SPIN : SPIN + 3] - interception[:, 6:],
                sample - ball[:, :6],
            ),
            axis=1,
        )
        for moment in MOMENTS_MS:
            rows = (
                in_play & (since == moment) & ((rallies.state < State.TAU_2) | (rallies.state >= State.TAU_S))
            )
            found[moment].append(errors[rows])
    return {moment: np.concatenate(parts) for moment, parts in found.items()}


def figures(errors: Mapping[int, Array]) -> list[dict[str, float | list[float]]]:
    """Return medians of distances, and root mean square errors of the spin per axis, by moment."""

    def median(rows: Array, at: int, unit: float) -> float:
        return round(unit * float(np.median(np.linalg.norm(rows[:, at : at + 3], axis=1))), 3)

    return [
        {
            "since_bounce_ms": moment,
            "balls": len(rows),
            "present_mm": median(rows, 0, 1e3),
            "present_velocity_m_s": median(rows, 3, 1.0),
            "meeting_mm": median(rows, 6, 1e3),
            "meeting_velocity_m_s": median(rows, 9, 1.0),
            "spin_rad_s": [round(float(v), 1) for v in np.sqrt((rows[:, 12:15] ** 2).mean(axis=0))],
            "sample_mm": median(rows, 15, 1e3),
            "sample_velocity_m_s": median(rows, 18, 1.0),
        }
        for moment, rows in errors.items()
        if len(rows) >= FEWEST
    ]


class FlightFilterConfig(BenchmarkConfig):
    """Measure the errors of the flight filter: the ball now, its predicted interception, and its spin."""

    balls: int = Field(2000, ge=100, description="balls to compare")
    launch: PresetName = Field("paper", description="launch preset")
    expected_spin: ExpectedSpin = Field("mild", description="spin that the filter expects")
    randomization: Randomization = Field("standard", description="profile of what differs between rallies")
    seed: int = Field(0, ge=0, lt=2**63, description="of the balls")


def main(config: FlightFilterConfig, _stop: Event) -> int:
    """Measure and print."""
    rows = figures(
        compare(config.balls, config.launch, config.randomization, config.seed, config.expected_spin)
    )
    if config.json_line:
        about = {
            "launch": config.launch,
            "randomization": config.randomization,
            "expected_spin": config.expected_spin,
        }
        print(json.dumps(about | {"by_moment": rows}))
    else:
        for row in rows:
            print("  ".join(f"{name} {value}" for name, value in row.items()))
    return 0


if __name__ == "__main__":
    sys.exit(run("flight_filter", FlightFilterConfig, main))
