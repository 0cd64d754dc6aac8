"""The page's ball, rules, perception and observation against ours, on recorded rallies."""

import json
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from common.env.rally_env import Launches, RallyEnv
from common.env.robot import RobotBatch
from common.evaluation.match import evaluation_rallies, match_task
from common.policy.box import policy_folder
from common.policy.folder import load_policy
from common.task.config import MatchConditions
from common.task.experience import MATCH
from common.task.launch import LIFT_FACTOR
from topspin.web.folder import PAGE
from topspin.web.module import ball_module
from topspin.web.values import ROUNDS, packed, values_of

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no Node.js here, which runs the page's programs")


class Given:
    """A source of the same rallies again and again."""

    def __init__(self, rallies):
        self._rallies = rallies

    def take(self, rows):
        dealt = self._rallies.of(np.arange(rows.size))
        return Launches(dealt.launches, dealt.seeds, np.ones(rows.size, np.bool_))


@cache
def recorded(policy, launch, perception, count):
    """Return the task, and ``count`` rallies with all that goes into a control step and comes out of it."""
    policy = load_policy(policy_folder(policy))
    task = match_task(policy.contract, MatchConditions(launch=launch, perception=perception, rounds=ROUNDS))
    rallies = evaluation_rallies(count, task, 7)
    env = RallyEnv(count, task, Given(rallies), stage=3, experience=MATCH)
    obs, found = env.reset(), [[] for _ in range(count)]
    is_over = np.zeros(count, np.bool_)
    while not is_over.all():
        actions = np.clip(policy.act(obs), -1.0, 1.0)
        joint_pos, joint_vel, before = env.robot.joint_pos.copy(), env.robot.joint_vel.copy(), obs
        step = env.step(actions)
        obs = step.obs
        outcomes = dict(zip(step.finished.rows.tolist(), step.finished.outcomes.tolist(), strict=True))
        for row in np.flatnonzero(~is_over):
            found[row].append(
                {
                    "joint_pos": joint_pos[row].tolist(),
                    "joint_vel": joint_vel[row].tolist(),
                    "obs": before[row, : policy.network.obs_size].tolist(),
                    "actions": actions[row].tolist(),
                    "path": env.motion.joint_pos[row].ravel().tolist(),
                    "outcome": outcomes.get(row, 0),
                    "ball": None if row in outcomes else env.rallies.ball[row].tolist(),
                }
            )
        is_over[list(outcomes)] = True
    return task, rallies, found


def differences(folder, task, rallies, steps, launches):
    """Return the largest differences between the page's rallies and the recorded ones."""
    shutil.copy(PAGE / "ball.js", folder / "ball.mjs")
    (folder / "ball.wasm").write_bytes(ball_module())
    block = packed(values_of(task, RobotBatch(1, task.robot, task.control_rate_hz)))
    (folder / "values.bin").write_bytes(block.content)
    (folder / "places.json").write_text(json.dumps(block.places))
    named = zip(launches.tolist(), map(str, rallies.seeds), steps, strict=True)
    given = [dict(zip(("launch", "seed", "steps"), rally, strict=True)) for rally in named]
    (folder / "rallies.json").write_text(json.dumps(given))
    drive = Path(__file__).with_name("drive.mjs")
    done = subprocess.run([NODE, drive, folder], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("policy", "launch", "perception"),
    [("mild", "paper", "cheap"), ("default", "all", "full"), ("paper", "strong", "full")],
)
def test_the_pages_ball_flies_bounces_and_is_observed_as_ours(policy, launch, perception, tmp_path):
    task, rallies, steps = recorded(policy, launch, perception, 16)

    found = differences(tmp_path, task, rallies, steps, rallies.launches)

    assert found["steps"] > 700
    assert found["pos"] < 1e-6  # [m]
    assert found["vel"] < 1e-5  # [m/s]
    assert found["spin"] < 1e-4  # [rad/s]
    assert found["obs"] < 1e-5
    assert found["outcomes"] == 0


def test_a_wrong_sign_of_the_lift_is_found(tmp_path):
    task, rallies, steps = recorded("default", "paper", "cheap", 16)
    turned = rallies.launches.copy()
    turned[:, LIFT_FACTOR] *= -1.0

    found = differences(tmp_path, task, rallies, steps, turned)

    assert found["pos"] > 0.01  # [m]
    assert found["obs"] > 0.01
    assert found["outcomes"] > 0
