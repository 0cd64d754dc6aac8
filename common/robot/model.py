"""The MuJoCo model of a robot beside a table: its MJCF, with drives, contacts, sensors and surroundings added.

The drive of a joint is a motor with a position controller, as industrial servo drives are. The controller asks for the
torque kp (target - position) - kv speed. The current limits it to the drive's force. The voltage limits it too, because
the motor's back-EMF grows with the speed: it leaves no torque at ``NO_LOAD`` of the speed limit, and brakes above it
(MuJoCo's ``dcmotor``). Losses grow with the speed, as those of bearings and of a braking resistor do. So a joint that
the others throw towards its limit is braked by several times its drive's force, and holds the limit in coupled motion.
The covers of the parts that the arm can strike on the robot itself are soft (ADR-0041).
"""

import xml.etree.ElementTree as ET
from typing import Final, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from common.physics.constants import (
    FLOOR_Z,
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_THICKNESS,
)
from common.physics.touch import NET_HALF_THICKNESS
from common.robot.description import JointDrive, RobotDescription, RobotError, describe, model_path

Array = npt.NDArray[np.float64]

STALL: Final = 6.0
"""A motor's torque at a standstill at full voltage, over the drive's force: sets where the voltage begins to limit."""
NO_LOAD: Final = 0.9  # of the speed limit: the speed at which the motor's torque vanishes
LINEAR_LOSS, CUBIC_LOSS = 0.5, 1.5  # at the speed limit, over the drive's force
COVER: Final = 0.030  # [m] thickness of the soft covers
COVER_SOLIMP: Final = "0.5 0.95 0.03"  # softest at the surface, stiff at the hard part under it
SURROUNDINGS: Final = ("table", "net", "floor")


class LinkSensors(NamedTuple):
    """What the links' sensors measured, in the order of MuJoCo's sensor data."""

    touch: Array  # (..., links) [N] force of all contacts
    own: Array  # (..., links, 4) [N, m] force of the deepest contact with the robot, and its distance
    table: Array  # (..., links, 3) [N] largest force on the table

    @classmethod
    def of(cls, data: Array, links: int) -> "LinkSensors":
        """Return the sensors of ``links`` links from MuJoCo's sensor data (..., n)."""
        touch, own, table = links, 5 * links, 8 * links
        lead = data.shape[:-1]
        return cls(
            data[..., :touch],
            data[..., touch:own].reshape(*lead, links, 4),
            data[..., own:table].reshape(*lead, links, 3),
        )


def _drive(joint: JointDrive) -> ET.Element:
    return ET.Element(
        "dcmotor",
        name=joint.name,
        joint=joint.name,
        input="pos",
        nominal=f"1 {STALL * joint.force} {NO_LOAD * joint.speed}",
        saturation=f"{joint.force} 0 0",
        controller=f"{joint.kp} 0 {joint.kv} 0 0 1",
        ctrlrange=f"{joint.range[0]} {joint.range[1]}",
    )


def _surroundings() -> list[ET.Element]:
    common = {"contype": "0", "conaffinity": "1", "condim": "3", "friction": "0.4"}
    length, width, thickness = TABLE_HALF_LENGTH, TABLE_HALF_WIDTH, 0.5 * TABLE_THICKNESS
    return [
        ET.Element("light", pos="0 0 3", dir="0 0 -1", diffuse="0.5 0.5 0.5"),
        ET.Element("geom", common, name="floor", type="plane", size="6 4 0.1", pos=f"0 0 {FLOOR_Z}"),
        ET.Element(
            "geom",
            common,
            name="table",
            type="box",
            size=f"{length} {width} {thickness}",
            pos=f"0 0 {-thickness}",
        ),
        ET.Element(
            "geom",
            common,
            name="net",
            type="box",
            size=f"{NET_HALF_THICKNESS} {NET_HALF_WIDTH} {0.5 * NET_HEIGHT}",
            pos=f"0 0 {0.5 * NET_HEIGHT}",
        ),
    ]


def _parent_of(root: ET.Element, kind: str, name: str) -> ET.Element:
    for parent in root.iter("body"):
        for child in parent.findall(kind):
            if child.get("name") == name:
                return parent
    raise RobotError(f"{kind} {name!r} is not in the robot's MJCF; allowed: one inside a body")


def _sensors(root: ET.Element, robot: RobotDescription) -> ET.Element:
    """Return the links' sensors, in the order of ``LinkSensors``, and add the sites that they need."""
    bodies = root.find("worldbody")
    base = None if bodies is None else bodies.find("body")
    if base is None:
        raise RobotError("the robot's MJCF has no body")
    found = ET.Element("sensor")
    for link in robot.links:
        body = _parent_of(root, "geom", link)
        site = ET.Element("site", name=f"{link}_touch", type="sphere", size="1", rgba="0 0 0 0", group="4")
        body.append(site)
        found.append(ET.Element("touch", name=f"{link}_touch", site=f"{link}_touch"))
    for link in robot.links:
        found.append(
            ET.Element(
                "contact",
                name=f"{link}_self",
                geom1=link,
                subtree2=base.get("name", ""),
                data="force dist",
                reduce="mindist",
            )
        )
    for link in robot.links:
        found.append(
            ET.Element(
                "contact", name=f"{link}_table", geom1=link, geom2="table", data="force", reduce="maxforce"
            )
        )
    return found


def robot_xml(name: str) -> str:
    """Return the whole MJCF of a robot beside a table.

    Raises:
        RobotError: The robot's files are missing or don't fit together.
    """
    robot, path = describe(name), model_path(name)
    try:
        root = ET.fromstring(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RobotError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    except ET.ParseError as error:
        raise RobotError(f"{path}: not readable as XML: {error}") from None
    world = root.find("worldbody")
    if world is None:
        raise RobotError(f"{path}: no worldbody")
    for joint in robot.joint:
        body = _parent_of(root, "joint", joint.name)
        element = next(e for e in body.findall("joint") if e.get("name") == joint.name)
        linear, cubic = LINEAR_LOSS * joint.force / joint.speed, CUBIC_LOSS * joint.force / joint.speed**3
        element.set("damping", f"{linear} 0 {cubic}")
    sensors = _sensors(root, robot)
    for index, thing in enumerate(_surroundings()):
        world.insert(index, thing)
    drives = ET.SubElement(root, "actuator")
    drives.extend(_drive(joint) for joint in robot.joint)
    contacts = ET.SubElement(root, "contact")
    for first, second in robot.self_contacts:
        contacts.append(
            ET.Element(
                "pair",
                name=f"{first}-{second}",
                geom1=first,
                geom2=second,
                condim="1",
                margin=str(COVER),
                solref=f"{robot.cover_s} 1",  # critically damped
                solimp=COVER_SOLIMP,
            )
        )
    root.append(sensors)
    home = " ".join(str(joint.home) for joint in robot.joint)
    ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="home", qpos=home, ctrl=home)
    return ET.tostring(root, encoding="unicode")


def load_model(name: str = "rails", step: float = 0.004) -> mujoco.MjModel:
    """Return the compiled model of a robot beside a table.

    Args:
        name: Of the robot.
        step: MuJoCo's time step [s].

    Raises:
        RobotError: The robot's files are missing or wrong.
    """
    try:
        model = mujoco.MjModel.from_xml_string(robot_xml(name))
    except ValueError as error:
        raise RobotError(f"robot {name}: {str(error).splitlines()[0]}") from None
    model.opt.timestep = step
    return model
