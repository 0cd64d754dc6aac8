"""How well the flight so far tells where the ball is, how it spins, and how it will come to be met.

    python -m benchmarks.prediction --json

Balls fly past a robot that stands still; every control step what ``common/rally/prediction.py`` makes of their samples
is compared with the truth: where each ball is, and what it will be like 0.12 s behind its bounce.
"""

import argparse
import json
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from benchmarks.env import MemoryRallies
from common.env.rally_env import EnvConfig, RallyEnv
from common.physics.constants import GRID_STEP
from common.physics.flight import SIMPLE, flight_step
from common.physics.fly import NO_ROBOT, fly_to_touch
from common.physics.table_bounce import table_bounce
from common.rally.launch import LONGEST_FLIGHT, RallyBlock, draw_rallies
from common.rally.launch_presets import PRESETS
from common.rally.noise import PROFILES
from common.rally.observation import Expectation, ObservationConfig
from common.rally.play import SAMPLE
from common.rally.prediction import MEETING, MEETING_AFTER, PRESENT, SPIN
from common.rally.trajectory import State

Array = npt.NDArray[np.float64]

STEPS = 40  # control steps watched: 0.8 s
MOMENTS_MS = (-300, -200, -100, -40, 0, 40, 80, 120, 200)  # since the bounce, to the nearest control step
FEWEST = 50  # balls at a moment that it is reported for


def truth(block: RallyBlock, conditions: Array) -> tuple[Array, Array]:
    """Return when each ball bounces (n,) [s], and position, velocity and spin at its meeting (n, 9)."""
    bounce, meeting = np.empty(len(block.seeds)), np.empty((len(block.seeds), 9))
    for k, (launch, condition) in enumerate(zip(block.launches, conditions, strict=True)):
        pos, vel, spin = tuple(launch[:3]), tuple(launch[3:6]), tuple(launch[6:9])
        air = (condition[0], condition[1], SIMPLE)
        pos, vel, bounce[k], _, normal = fly_to_touch(pos, vel, spin, LONGEST_FLIGHT, *air, NO_ROBOT)
        vel, spin = table_bounce(vel, spin, normal, condition[2], condition[3])
        for _ in range(round(MEETING_AFTER / GRID_STEP)):
            pos, vel = flight_step(pos, vel, spin, GRID_STEP, *air)
        meeting[k] = [*pos, *vel, *spin]
    return bounce, meeting


def watch(balls: int, preset: str, noise: str, seed: int, expected: Expectation = "mild") -> dict[int, Array]:
    """Return errors by moment since the bounce [ms]: rows of present 6, meeting 6, spin 3, and the sample's own 6."""
    block = draw_rallies(balls, seed=seed, preset=preset, noise=noise)
    config = EnvConfig(
        noise=noise, foresee=0.0, go_on=0.0, observation=ObservationConfig(spin_expected=expected)
    )
    env = RallyEnv(balls, config, MemoryRallies(block))
    env.reset()
    rallies, hold = env.rallies, np.tile(env.home_action, (balls, 1))
    bounce, meeting = truth(block, rallies.condition)
    found: dict[int, list[Array]] = {moment: [] for moment in MOMENTS_MS}
    in_play = np.ones(balls, np.bool_)
    for _ in range(STEPS):
        in_play[env.step(hold).ended] = False
        since = 20 * np.rint((rallies.clock * GRID_STEP - bounce) / 0.020)
        seen, track, ball = rallies.seen[:, : SAMPLE - 1], rallies.track, rallies.ball
        errors = np.concatenate(
            (
                track[:, PRESENT : PRESENT + 6] - ball[:, :6],
                track[:, MEETING + 1 : MEETING + 7] - meeting[:, :6],
                track[:, SPIN : SPIN + 3] - meeting[:, 6:],
                seen - ball[:, :6],
            ),
            axis=1,
        )
        for moment in MOMENTS_MS:
            rows = in_play & (since == moment) & (rallies.state < State.TAU_2)
            found[moment].append(errors[rows])
    return {moment: np.concatenate(parts) for moment, parts in found.items()}


def figures(errors: Mapping[int, Array]) -> list[dict[str, float | list[float]]]:
    """Return medians of distances, and root mean squares of the spin a axis, by moment."""

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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.prediction",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--balls", type=int, default=2000, help="how many, 100 or more (default 2000)")
    parser.add_argument("--launch", choices=PRESETS, default="paper", help="launch preset (default paper)")
    parser.add_argument(
        "--spin-expected",
        choices=("mild", "mixed", "strong"),
        default="mild",
        help="env.observation.spin_expected of a first ball (default mild)",
    )
    parser.add_argument("--noise", choices=PROFILES, default="standard", help="profile (default standard)")
    parser.add_argument("--seed", type=int, default=0, help="of the balls (default 0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    options = parser.parse_args()
    if options.balls < 100:
        parser.error(f"--balls: got {options.balls}; allowed: 100 or more")
    if options.seed < 0:
        parser.error(f"--seed: got {options.seed}; allowed: 0 or more")
    rows = figures(watch(options.balls, options.launch, options.noise, options.seed, options.spin_expected))
    if options.json:
        about = {"launch": options.launch, "noise": options.noise, "spin_expected": options.spin_expected}
        print(json.dumps(about | {"by_moment": rows}))
        return
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))


if __name__ == "__main__":
    main()
