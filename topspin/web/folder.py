"""The folder of a page: its programs, the compiled kernels, the policy, the robot, balls to play, and libraries."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, get_args

from common.env.robot import RobotBatch
from common.evaluation.config import SEED, MatchSpin
from common.evaluation.match import evaluation_rallies, match_task
from common.physics.constants import BALL_RADIUS, GRID_STEP
from common.policy.folder import Policy
from common.robot.model import robot_xml
from common.task.config import MatchConditions, PresetName, TaskConfig
from common.task.randomization import RallyParameter
from common.task.states import Outcome
from topspin.export.folder import whole_folder, write_network
from topspin.render.overlay import BAD_RGB, GOOD_RGB, OUTCOME_WORDS
from topspin.render.scene import CAMERAS, FIELD_OF_VIEW_DEG, TARGET_RGB, TRAIL
from topspin.view.shapes import Robot
from topspin.web import packages
from topspin.web.module import ball_module
from topspin.web.values import packed, values_of

PAGE: Final = Path(__file__).with_name("page")
BALLS: Final = 500  # of each kind; then they begin again

_LIBRARIES: Final = """Libraries of this page, as they are in the npm registry:

{}
Their texts: LICENSE files here, and https://www.apache.org/licenses/LICENSE-2.0 for Apache-2.0.
"""


def write_page(policy: Policy, name: str, out: Path, expected_spin: MatchSpin = "contract") -> float:
    """Write the folder of a page; return the largest difference of an action from the policy's.

    Args:
        policy: The policy.
        name: What it is called.
        out: New or empty. It is complete or untouched.
        expected_spin: What the observer expects of the balls' spin.

    Raises:
        ReportedError: A library is missing, or the folder can't be written.
    """
    task = match_task(policy.contract, MatchConditions(), expected_spin)
    with whole_folder(out) as folder:
        vendor = folder / "vendor"
        vendor.mkdir()
        packages.fetch(vendor)  # first: it is what can fail
        (vendor / "README.md").write_text(_LIBRARIES.format(packages.listed()))
        _, parity = write_network(policy, name, folder, expected_spin)
        shutil.copytree(PAGE, folder, dirs_exist_ok=True)
        robot = RobotBatch(1, task.robot, task.control_rate_hz)
        block = packed(values_of(task, robot))
        (folder / "ball.wasm").write_bytes(ball_module())
        (folder / "values.bin").write_bytes(block.content)
        (folder / "robot.xml").write_text(robot_xml(task.robot))
        _write_balls(task, folder / "balls")
        facts = {"policy": name, "places": block.places}
        facts |= {"robot": _robot_facts(robot), "scene": _scene_facts(task.robot), **_rally_facts()}
        (folder / "page.json").write_text(json.dumps(facts))
    return parity


def _write_balls(task: TaskConfig, folder: Path) -> None:
    """Write launches (n, 12) and seeds (n,) of each kind of ball: the first ones of `topspin evaluate`."""
    folder.mkdir()
    for preset in get_args(PresetName):
        drawn = evaluation_rallies(BALLS, task.model_copy(update={"launch": preset}), SEED)
        (folder / f"{preset}.bin").write_bytes(drawn.launches.tobytes() + drawn.seeds.tobytes())


def _rally_facts() -> dict[str, Any]:
    return {
        "balls": BALLS,
        "kinds": get_args(PresetName),
        "grid_s": GRID_STEP,
        "parameters": {parameter.name: int(parameter) for parameter in RallyParameter},
        "outcomes": [OUTCOME_WORDS[outcome] for outcome in Outcome],
        "returned": int(Outcome.RETURNED),
    }


def _robot_facts(robot: RobotBatch) -> dict[str, Any]:
    joints, model = robot.description.joint, robot.model
    return {
        "name": robot.name,
        "racket": model.body(model.geom_bodyid[model.geom(robot.description.racket).id]).name,
        "substeps": robot.substeps,
        "step_s": robot.step_s,
        "middle": robot.middle.tolist(),
        "half_range": robot.half_range.tolist(),
        "home": robot.home.tolist(),
        "kp": [joint.kp for joint in joints],
        "kv": [joint.kv for joint in joints],
    }


def _scene_facts(robot: str) -> dict[str, Any]:
    drawn = Robot(robot)
    return {
        "bodies": drawn.bodies,
        "shapes": [asdict(shape) for shape in drawn.shapes],
        "ball_radius": BALL_RADIUS,
        "trail": [{"colour": colour.rgb, "label": colour.label} for _, colour in sorted(TRAIL.items())],
        "colours": {"good": GOOD_RGB, "bad": BAD_RGB, "target": TARGET_RGB},
        "cameras": {"wide": asdict(CAMERAS["side"]), "upright": asdict(CAMERAS["behind"])},
        "field_of_view_deg": FIELD_OF_VIEW_DEG,
    }
