"""The reference of the robots: their joints and drives, from their tables."""

from typing import get_args

from common.robot.chain_of import chain_of
from common.robot.description import describe
from common.task.config import RobotName


def markdown() -> str:
    """Return the page."""
    lines = [
        "# Robots",
        "",
        "`--task.robot NAME`. Each robot is a folder of `common/robot/robots`: an MJCF and a table, `robot.toml`.",
        "An action of -1 or 1 is an end of a joint's range.",
        "[Robots and drives](../robots.md) says what the limits mean.",
    ]
    for name in get_args(RobotName):
        robot = describe(name)
        lines += [
            "",
            f"## {name}",
            "",
            f"{robot.summary[0].upper()}{robot.summary[1:]}.",
            "",
            "| joint | range | home | speed limit | largest force | k_p | k_v |",
            "|---|---|---|---|---|---|---|",
        ]
        for joint, is_hinge in zip(robot.joint, chain_of(name).joints[:, 0], strict=True):
            unit, force = ("rad", "Nm") if is_hinge else ("m", "N")
            low, high = joint.range
            lines.append(
                f"| {joint.name} | {low:g} to {high:g} {unit} | {joint.home:g} | {joint.speed:g} {unit}/s | "
                f"{joint.force:g} {force} | {joint.kp:g} | {joint.kv:g} |"
            )
        pairs = ", ".join(f"{first} and {second}" for first, second in robot.self_contacts)
        lines += [
            "",
            f"Parts of its own that can meet: {pairs}. Time constant of their covers: {robot.cover_s:g} s.",
        ]
    return "\n".join(lines) + "\n"
