"""`python -m topspin_robot FOLDER`: check an exported policy on this computer, and time it."""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from common.errors import ReportedError
from common.physics.chain import JOINTS
from topspin.robot.contract import RobotContract
from topspin.robot.controller import Controller, load
from topspin.robot.made_up_ball import detections

BALL_S: Final = 0.4  # [s] of a made-up ball: it has bounced and is beside the robot


def time_steps(
    controller: Controller, steps: int, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """Return the times [s] that ``steps`` control steps took by ``clock``, with made-up balls at the camera's rate."""
    period, home = controller.contract.period, controller.contract.of_joints("home")
    taken: list[float] = []
    start = max(controller.now, 0.0) + 2.0 * BALL_S
    while len(taken) < steps:
        controller.begin((0.9, 0.0))
        pictures = list(detections(BALL_S))
        for k in range(round(BALL_S / period)):
            now = k * period
            while pictures and pictures[0][0] <= now:
                moment, pos = pictures.pop(0)
                controller.see(start + moment, pos)
            before = clock()
            controller.step(start + now, home, np.zeros(JOINTS))
            taken.append(clock() - before)
        start += 2.0 * BALL_S
    return taken[:steps]


def joint_table(contract: RobotContract) -> list[str]:
    """Return the joints' mapping and limits as lines of text."""
    rows: list[tuple[str, ...]] = [("joint", "unit", "middle", "half range", "home", "speed", "force")]
    for joint in contract.joints:
        numbers = (joint.middle, joint.half_range, joint.home, joint.speed, joint.force)
        rows.append((joint.name, "m" if joint.kind == "slide" else "rad", *(f"{n:g}" for n in numbers)))
    return ["  ".join(f"{word:>10}" for word in row) for row in rows]


def main(argv: Sequence[str]) -> int:
    """Load, print what the contract says, and time; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m topspin_robot",
        description="Check an exported policy on this computer: read it, compile its kernels, show what it expects "
        "of the joints, and time its control steps.",
    )
    parser.add_argument("folder", help="folder of `topspin export`")
    parser.add_argument(
        "--steps", type=int, default=2000, metavar="N", help="control steps to time (default: 2000)"
    )
    arguments = parser.parse_args(argv)
    if arguments.steps < 1:
        parser.error(f"--steps {arguments.steps}; allowed: a whole number from 1")
    started = time.perf_counter()
    try:
        controller = load(arguments.folder)
    except ReportedError as error:
        sys.stderr.write(f"{parser.prog}: {error}\n")
        return 1
    ready = time.perf_counter() - started
    contract = controller.contract
    taken = 1e3 * np.array(time_steps(controller, arguments.steps))
    median, slow = np.percentile(taken, [50, 99])
    lines = [
        f"policy {contract.policy} for robot {contract.robot}: {contract.size} numbers in, {JOINTS} joint targets out",
        f"frame {contract.frame}",
        *joint_table(contract),
        f"ready after {ready:.1f} s; the first time it compiles, later the result is read from the disk",
        f"a control step takes {median:.3f} ms (p50), {slow:.3f} ms (p99), of {1e3 * contract.period:g} ms",
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
