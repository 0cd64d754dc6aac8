"""Robots as data: a new robot is a folder, and a mistake in it is an error in one line."""

import shutil
from typing import get_args

import mujoco
import numpy as np
import pytest

from common.env.robot import RobotBatch
from common.physics.chain import racket_pose
from common.robot import chain_of as chains
from common.robot import description
from common.robot.chain_of import chain_of
from common.robot.description import ROBOTS, RobotError, describe, robot_names
from common.robot.model import load_model
from common.task.config import RobotName
from topspin.render.hall import load_hall


@pytest.fixture
def robots(tmp_path, monkeypatch):
    """A folder of robots with copies of those that ship; what was read before is forgotten."""
    folder = tmp_path / "robots"
    shutil.copytree(ROBOTS, folder)
    monkeypatch.setattr(description, "ROBOTS", folder)
    describe.cache_clear()
    chains.chain_of.cache_clear()
    yield folder
    describe.cache_clear()
    chains.chain_of.cache_clear()


def test_the_tasks_robots_are_the_folders():
    assert sorted(get_args(RobotName)) == robot_names()


def test_a_new_robot_is_a_folder_with_a_model_and_a_table(robots):
    """As docs/robots.md says: a longer forearm, and a slower elbow."""
    shutil.copytree(robots / "rails", robots / "long")
    model, table = robots / "long" / "robot.xml", robots / "long" / "robot.toml"
    text = model.read_text()
    model.write_text(
        text.replace('fromto="0 0 0 0 0 0.20" mass="0.6"', 'fromto="0 0 0 0 0 0.30" mass="0.6"').replace(
            '<body name="wrist" pos="0 0 0.20">', '<body name="wrist" pos="0 0 0.30">'
        )
    )
    table.write_text(table.read_text().replace('name = "elbow"', 'name = "elbow"  # slower'))
    straight = (0.0,) * 7
    before, after = (racket_pose(chain_of(name), straight).centre for name in ("rails", "long"))

    np.testing.assert_allclose(np.subtract(after, before), [0.0, 0.0, 0.1], atol=1e-12)
    robot = RobotBatch(2, "long")
    motion = robot.step(np.tile(robot.home_action, (2, 1)))
    data = mujoco.MjData(robot.model)
    data.qpos[:] = motion.joint_pos[0, -1]
    mujoco.mj_kinematics(robot.model, data)
    pose = racket_pose(robot.chain, tuple(motion.joint_pos[0, -1]))
    np.testing.assert_allclose(pose.centre, data.site("racket").xpos, atol=1e-12)


def test_a_variant_of_a_robot_is_a_table_that_names_its_model(robots):
    (robots / "slow").mkdir()
    table = (robots / "usst" / "robot.toml").read_text()
    (robots / "slow" / "robot.toml").write_text(table.replace("speed = 2.0", "speed = 1.0"))

    assert describe("slow").joint[0].speed == 1.0
    np.testing.assert_array_equal(chain_of("slow").joints, chain_of("rails").joints)


@pytest.mark.parametrize(
    ("file", "old", "new", "error"),
    [
        ("robot.toml", "home = 1.1", "home = 3.0", r"joint\.5: Value error, home 3; allowed: -2.1 to 2.1"),
        ("robot.toml", "speed = 15.0", "speed = 0.0", r"joint\.\d\.speed: Input should be greater than 0"),
        ("robot.toml", "range = [-0.75, 0.75]", "range = [0.75, -0.75]", r"range \[0.75, -0.75\]; allowed"),
        ("robot.toml", "force = 400.0", "forces = 400.0", r"joint\.0\.force"),
        ("robot.toml", "[[joint]]", "[joint", r"robot\.toml: "),
        ("robot.toml", 'name = "roll"', 'name = "rol"', r"joint 'rol' is not in the robot's MJCF"),
        ("robot.toml", '"wrist", "racket"]', '"wrist", "bat"]', r"geom 'bat' is not in the robot's MJCF"),
        (
            "robot.toml",
            "links =",
            'racket = "bat"\nlinks =',
            r"racket 'bat'; allowed: the name of a geom and of a",
        ),
        ("robot.toml", "links =", 'model = "railz"\nlinks =', r"railz.robot\.xml: No such file"),
        ("robot.xml", "</worldbody>", "", r"robot\.xml: not readable as XML: mismatched tag"),
        (
            "robot.xml",
            '<site name="racket"',
            '<site name="other"',
            r"racket 'racket'; allowed: the name of a geom",
        ),
        (
            "robot.xml",
            'axis="0 0 1" range="-3.05',
            'axis="0 1 1" range="-3.05',
            r"joint yaw has axis \[0.0, 0.707",
        ),
        (
            "robot.xml",
            'type="capsule" size="0.03"',
            'type="cylinder" size="0.03"',
            r"geom forearm is neither",
        ),
    ],
)
def test_a_mistake_in_a_robots_files_is_one_line_that_says_what_is_allowed(robots, file, old, new, error):
    shutil.copytree(robots / "rails", robots / "wrong")
    path = robots / "wrong" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))

    with pytest.raises(RobotError, match=error) as raised:
        chain_of("wrong")
    assert "\n" not in str(raised.value)


def test_a_new_robot_is_drawn_whatever_its_bodies_are_called(robots):
    shutil.copytree(robots / "rails", robots / "other")
    model = robots / "other" / "robot.xml"
    text = model.read_text().replace('<body name="yaw"', '<body name="turn"')
    text = text.replace('<body name="racket"', '<body name="bat"').replace('"0.076 0.0065"', '"0.09 0.0065"')
    model.write_text(text)

    drawn = load_hall("other")

    red = drawn.geom_matid == drawn.material("red rubber").id
    assert drawn.geom_size[red, 0] == pytest.approx([0.09])
    assert [drawn.body(of).name for of in drawn.geom_bodyid[red]] == ["bat"]


def test_a_table_with_another_number_of_joints_is_refused(robots):
    shutil.copytree(robots / "rails", robots / "six")
    table = robots / "six" / "robot.toml"
    table.write_text(table.read_text().rsplit("[[joint]]", 1)[0])

    with pytest.raises(RobotError, match="6 joints; allowed: 7"):
        describe("six")


def test_the_drives_have_the_tables_force_and_lose_it_below_the_speed_limit():
    """A motor at full voltage: none of its torque is left at 0.9 of the limit, and its losses are twice its force."""
    model = load_model("rails")
    elbow = 4
    resistance, constant = model.actuator_gainprm[elbow, :2]

    np.testing.assert_allclose(model.actuator_forcerange[elbow], [-12.0, 12.0])
    assert 1.0 / constant == pytest.approx(0.9 * 15.0)  # full voltage is 1
    assert constant / resistance == pytest.approx(6 * 12.0)
    linear, cubic = model.dof_damping[elbow], model.dof_dampingpoly[elbow, 1]
    assert linear * 15.0 + cubic * 15.0**3 == pytest.approx(2 * 12.0)
