"""The model card of an exported policy: README.md in the form of the Hugging Face Hub."""

import json
from typing import Any, Final

from topspin.export.onnx_graph import OPSET
from topspin.robot.contract import RobotContract

_EXAM_COLUMNS: Final = ("exam", "balls", "air", "noise, latency", "perception", "returned", "landing error")
_LIMITS: Final = (
    "It has never been on a robot. All figures are of a simulation.",
    "It was trained on the balls and in the air named here. On others it returns less: measure it first.",
    "It knows one opponent's ball at a time, and no table or robot but the one of the contract.",
    "It does not know people or things in the robot's reach. A robot needs its own limits, fences and stop.",
    "A joint target is a set point for a position controller with the contract's gains and limits. It is not a point "
    "of a path that is to be reached within a control step.",
    "No licence has been chosen yet.",
)


def exam_rows(contract: RobotContract) -> list[dict[str, Any]]:
    """Return one row for each exam in the contract: the balls, the conditions, and what was found."""
    rows = []
    exams = dict(contract.measures)
    if "return_rate" in exams:  # a run's own evaluator has measured it, once, as it was trained
        match = exams.pop("match", {})
        as_trained = {
            name: contract.trained[name] for name in ("launch", "flight", "randomization", "perception")
        }
        exams = {"in its run": as_trained | exams | match}
    for name, found in exams.items():
        if not isinstance(found, dict) or "return_rate" not in found:
            continue
        rows.append(
            {
                "exam": name,
                "balls": f"{found['rallies']} `{found.get('launch', name)}`, {found.get('rounds', 1)} in a row",
                # Measures of before the air was a condition of an exam were made in the training's air
                "air": found.get("flight", contract.trained.get("flight", "?")),
                "noise": found.get("randomization", "?"),
                "perception": found.get("perception", "?"),
                "return_rate": found["return_rate"],
                "interval": found.get("return_rate_ci"),
                "error": found.get("target_error_mean"),
            }
        )
    return rows


def front_matter(contract: RobotContract, rows: list[dict[str, Any]]) -> str:
    """Return the card's metadata as the Hub reads it."""
    results = [
        {
            "task": {"type": "robotics", "name": "Table tennis: return to a target"},
            "dataset": {
                "type": "simulation",
                "name": f"{row['balls']}, air {row['air']}, randomization {row['noise']}",
            },
            "metrics": [
                {"type": "return_rate", "value": row["return_rate"]},
                {"type": "target_error_mean_m", "value": row["error"]},
            ],
        }
        for row in rows
    ]
    lines = [
        "library_name: topspin-robot",
        "pipeline_tag: robotics",
        "license: unknown",
        "tags: [robotics, reinforcement-learning, table-tennis, onnx, topspin]",
    ]
    if results:
        index = [{"name": f"topspin-{contract.policy}", "results": results}]
        lines.append(f"model-index: {json.dumps(index)}")
    return "\n".join(["---", *lines, "---"])


def _measured(contract: RobotContract, rows: list[dict[str, Any]]) -> list[str]:
    if not rows:
        return [
            "This policy has not been measured. `topspin evaluate --policy ...` measures it, and `topspin release` "
            "writes the figures into its contract."
        ]
    lines = [f"| {' | '.join(_EXAM_COLUMNS)} |", f"|{'---|' * len(_EXAM_COLUMNS)}"]
    for row in rows:
        low_high = f" ({row['interval'][0]:.1%} to {row['interval'][1]:.1%})" if row["interval"] else ""
        error = f"{row['error']:.2f} m" if row["error"] is not None else "-"
        rate = f"{row['return_rate']:.1%}{low_high}"
        cells = (row["exam"], row["balls"], row["air"], row["noise"], row["perception"], rate, error)
        lines.append(f"| {' | '.join(cells)} |")
    trained = contract.trained
    latency = trained["observation_latency_s"]
    return [
        *lines,
        "",
        "Rates are shares of all balls, with 95 % intervals. Randomization "
        f"`{trained['randomization']}`, in which it was trained: ball samples "
        f"{1e3 * latency[0]:.0f} to {1e3 * latency[1]:.0f} ms late, with noise of "
        f"{1e3 * trained['position_noise_m']:.0f} mm and {trained['velocity_noise_m_per_s']:.2f} m/s, "
        f"{trained['lost_samples']:.0%} lost; drives up to {1e3 * trained['action_latency_s'][1]:.0f} ms late.",
    ]


def model_card(contract: RobotContract, example: str, wheel: str, parity: float) -> str:
    """Return the card.

    Args:
        contract: Of the policy.
        example: The program that plays with it.
        wheel: Name of the wheel in the folder.
        parity: Largest difference of an action from the policy's own, as the export has found it.
    """
    rows = exam_rows(contract)
    trained = contract.trained
    joints = [
        "| joint | middle | half range | home | speed limit | largest force |",
        "|---|---|---|---|---|---|",
    ]
    for joint in contract.joints:
        unit, force = ("m", "N") if joint.kind == "slide" else ("rad", "Nm")
        joints.append(
            f"| {joint.name} | {joint.middle:g} {unit} | {joint.half_range:g} {unit} | {joint.home:g} {unit} | "
            f"{joint.speed:g} {unit}/s | {joint.force:g} {force} |"
        )
    lines = [
        front_matter(contract, rows),
        "",
        f"# Topspin policy `{contract.policy}` for robot `{contract.robot}`",
        "",
        f"Plays table tennis: it observes {contract.size} numbers and sends {len(contract.joints)} joint targets, "
        f"{contract.control_rate_hz:g} times a second, so that the ball lands on a target. Trained in simulation by "
        f"Topspin {contract.made_with.get('topspin', '')}. Its last run, `{trained['run']}`, had {trained['frames']:,} "
        f"frames on balls of launch `{trained['launch']}` in the air `{trained['flight']}`; it may have begun with "
        "a trained policy.",
        "",
        "## Files",
        "",
        "| file | what |",
        "|---|---|",
        f"| `policy.onnx` | network with normaliser, opset {OPSET}: `obs` (N, {contract.size}) to `actions` in -1..1 "
        f"and `joint_targets` [m, rad] |",
        "| `contract.json` | each number of observation and action, frame, joints, filters, conditions, measures |",
        f"| `{wheel}` | observer and controller: from a camera's detections to joint targets; no torch, no MuJoCo |",
        "| `example.py` | the program shown here |",
        "| `leapp.yaml` | `policy.onnx` as a LEAPP pipeline |",
        "",
        f"Actions of `policy.onnx` in ONNX Runtime differ from the trained network's by at most {parity:.1e}.",
        "",
        "## Use",
        "",
        f"    pip install {wheel}",
        "    python -m topspin_robot .      # checks the folder, compiles, and times a control step",
        "    python example.py",
        "",
        "```python",
        example.rstrip("\n"),
        "```",
        "",
        f"Frame: {contract.frame}. SI units and radians. The ball's stamps and the controller's time are of one clock. "
        "`python -m topspin_robot.ros2 .` is the same as a ROS 2 node.",
        "",
        "## Joints",
        "",
        *joints,
        "",
        "Target = middle + action x half range.",
        "",
        "## Measured",
        "",
        *_measured(contract, rows),
        "",
        "## Limits of use",
        "",
        *(f"- {limit}" for limit in _LIMITS),
    ]
    return "\n".join(lines) + "\n"
