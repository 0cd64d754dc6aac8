"""The model that is drawn: a robot of ``common/robot/robots`` in a hall, for pictures.

Only looks are added: the robot's bodies and joints are those of training, so its seven joint positions pose it.
This model is not simulated, and the training's model has none of its additions.
"""

from typing import Final, NamedTuple

import mujoco
import numpy as np

from common.physics.constants import (
    BALL_RADIUS,
    FLOOR_Z,
    NET_HALF_WIDTH,
    NET_HEIGHT,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_THICKNESS,
)
from common.robot.description import describe, model_path
from common.robot.model import robot_xml

Triple = tuple[float, float, float]
BALL: Final = "ball"
SAMPLES: Final = 4  # per pixel, for smooth edges
SHADOW_PIXELS: Final = 2048


class Finish(NamedTuple):
    """A material."""

    colour: tuple[float, float, float, float]
    specular: float
    shininess: float
    reflectance: float = 0.0


FINISHES: Final[dict[str, Finish]] = {
    "floor": Finish((0.34, 0.195, 0.18, 1.0), 0.1, 0.2),
    "table": Finish((0.035, 0.20, 0.33, 1.0), 0.25, 0.5),
    "line": Finish((0.93, 0.95, 0.95, 1.0), 0.1, 0.3),
    "net": Finish((0.10, 0.12, 0.14, 0.55), 0.0, 0.1),
    "frame": Finish((0.10, 0.11, 0.13, 1.0), 0.3, 0.4),
    "rail": Finish((0.50, 0.53, 0.57, 1.0), 0.9, 0.8),
    "shell": Finish((0.88, 0.89, 0.90, 1.0), 0.5, 0.7),
    "motor": Finish((0.16, 0.17, 0.19, 1.0), 0.6, 0.6),
    "accent": Finish((0.95, 0.42, 0.08, 1.0), 0.5, 0.6),
    "red rubber": Finish((0.75, 0.06, 0.07, 1.0), 0.2, 0.3),
    "black rubber": Finish((0.05, 0.05, 0.055, 1.0), 0.2, 0.3),
    "wood": Finish((0.72, 0.52, 0.31, 1.0), 0.2, 0.4),
    "ball": Finish((1.0, 1.0, 1.0, 1.0), 0.4, 0.6),
}

# The training model's own geoms: their materials; None: replaced by more detailed geoms
_DRESS: Final[dict[str, str | None]] = {
    "floor": None,
    "table": "table",
    "net": "net",
    "beam": "rail",
    "carriage": "motor",
    "column": "shell",
    "upper_arm": "shell",
    "forearm": "shell",
    "wrist": "motor",
    "racket": None,
    "handle": None,
}

_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_ACROSS: Final = (0.70710678, 0.70710678, 0.0, 0.0)  # turns a cylinder's axis from z to y
_ALONG: Final = (0.70710678, 0.0, 0.70710678, 0.0)  # from z to x

_LINE, _THIN = (
    0.010,
    0.0006,
)  # [m] half width of a line; its height above the surface, without which it flickers
_L, _W = TABLE_HALF_LENGTH, TABLE_HALF_WIDTH
_GANTRY_Y, _RAIL_FROM, _RAIL_TO = 1.16, -2.40, -0.55  # [m] the rails that the beam runs on


# Body, finish, shape, place and half sizes [m] in the body's frame, turn
_Part = tuple[str, str, int, Triple, Triple, tuple[float, ...] | None]


def _box(body: str, finish: str, pos: Triple, half: Triple) -> _Part:
    return body, finish, int(_BOX), pos, half, None


def _disc(body: str, finish: str, pos: Triple, radius: float, half: float, quat: tuple[float, ...]) -> _Part:
    return body, finish, int(_CYLINDER), pos, (radius, half, 0.0), quat


_UPRIGHT: Final = (1.0, 0.0, 0.0, 0.0)

HALL_PARTS: Final = (
    # table: lines, frame, legs
    _box("world", "line", (0.0, _W - _LINE, _THIN), (_L, _LINE, _THIN)),
    _box("world", "line", (0.0, -_W + _LINE, _THIN), (_L, _LINE, _THIN)),
    _box("world", "line", (_L - _LINE, 0.0, _THIN), (_LINE, _W, _THIN)),
    _box("world", "line", (-_L + _LINE, 0.0, _THIN), (_LINE, _W, _THIN)),
    _box("world", "line", (0.0, 0.0, _THIN), (_L, 0.0025, _THIN)),
    *(_box("world", "frame", (0.0, y, -0.055), (_L - 0.04, 0.015, 0.025)) for y in (-_W + 0.03, _W - 0.03)),
    *(_box("world", "frame", (x, 0.0, -0.055), (0.015, _W - 0.03, 0.025)) for x in (-_L + 0.05, _L - 0.05)),
    *(
        _box("world", "frame", (x, y, (FLOOR_Z - 0.03) / 2), (0.025, 0.025, -(FLOOR_Z + 0.03) / 2))
        for x in (-0.95, 0.95)
        for y in (-0.6, 0.6)
    ),
    # net: tape and posts
    _box("world", "line", (0.0, 0.0, NET_HEIGHT - 0.007), (0.005, NET_HALF_WIDTH, 0.0075)),
    *(
        _disc("world", "frame", (0.0, y, NET_HEIGHT / 2 - 0.02), 0.011, NET_HEIGHT / 2 + 0.02, _UPRIGHT)
        for y in (-NET_HALF_WIDTH, NET_HALF_WIDTH)
    ),
    *(
        _box("world", "frame", (0.0, side * (NET_HALF_WIDTH + _W) / 2, -0.03), (0.02, 0.09, 0.012))
        for side in (-1, 1)
    ),
)

# Robots with the model of ``rails``
GANTRY_PARTS: Final = (
    # gantry: two rails on legs, outside the table
    *(
        _box(
            "world",
            "frame",
            ((_RAIL_FROM + _RAIL_TO) / 2, y, 0.005),
            ((_RAIL_TO - _RAIL_FROM) / 2, 0.035, 0.03),
        )
        for y in (-_GANTRY_Y, _GANTRY_Y)
    ),
    *(
        _box(
            "world",
            "rail",
            ((_RAIL_FROM + _RAIL_TO) / 2, y, 0.045),
            ((_RAIL_TO - _RAIL_FROM) / 2, 0.012, 0.012),
        )
        for y in (-_GANTRY_Y, _GANTRY_Y)
    ),
    *(
        _box("world", "frame", (x, y, (FLOOR_Z - 0.025) / 2), (0.03, 0.03, -(FLOOR_Z + 0.025) / 2))
        for x in (_RAIL_FROM + 0.05, _RAIL_TO - 0.05)
        for y in (-_GANTRY_Y, _GANTRY_Y)
    ),
    *(
        _box("world", "frame", (x, y, FLOOR_Z + 0.01), (0.07, 0.07, 0.01))
        for x in (_RAIL_FROM + 0.05, _RAIL_TO - 0.05)
        for y in (-_GANTRY_Y, _GANTRY_Y)
    ),
    # beam: wagons on the rails, a groove for the carriage
    *(_box("beam", "motor", (0.0, y, -0.01), (0.09, 0.05, 0.045)) for y in (-_GANTRY_Y, _GANTRY_Y)),
    *(_box("beam", "accent", (0.0, y, 0.037), (0.09, 0.05, 0.003)) for y in (-_GANTRY_Y, _GANTRY_Y)),
    *(_box("beam", "motor", (x, 0.0, 0.0), (0.002, 1.09, 0.010)) for x in (-0.050, 0.050)),
    # carriage and column
    _box("carriage", "accent", (0.0, 0.0, 0.042), (0.06, 0.06, 0.003)),
    _disc("carriage", "motor", (0.0, 0.0, 0.06), 0.065, 0.02, _UPRIGHT),
    _disc("carriage", "accent", (0.0, 0.0, 0.083), 0.055, 0.003, _UPRIGHT),
    # joints: motor housings across the arm, with caps
    _disc("upper_arm", "motor", (0.0, 0.0, 0.0), 0.050, 0.055, _ACROSS),
    *(_disc("upper_arm", "accent", (0.0, y, 0.0), 0.034, 0.003, _ACROSS) for y in (-0.057, 0.057)),
    _disc("forearm", "motor", (0.0, 0.0, 0.0), 0.042, 0.047, _ACROSS),
    *(_disc("forearm", "accent", (0.0, y, 0.0), 0.028, 0.003, _ACROSS) for y in (-0.049, 0.049)),
    _disc("wrist", "shell", (0.0, 0.0, 0.0), 0.033, 0.036, _ACROSS),
    *(_disc("wrist", "accent", (0.0, y, 0.0), 0.021, 0.003, _ACROSS) for y in (-0.038, 0.038)),
    _disc("wrist", "accent", (0.0, 0.0, 0.060), 0.027, 0.004, _UPRIGHT),
)


def racket_parts(body: str, radius: float, half: float) -> tuple[_Part, ...]:
    """Return the parts of a racket: wood between two rubbers, red towards the opponent at home; handle to the wrist.

    Args:
        body: That carries it.
        radius: [m]
        half: Half its thickness [m].
    """
    return (
        _disc(body, "wood", (0.0, 0.0, 0.0), radius + 0.0015, half - 0.0045, _ALONG),
        _disc(body, "red rubber", (-half / 2 - 0.001, 0.0, 0.0), radius, half / 2 - 0.001, _ALONG),
        _disc(body, "black rubber", (half / 2 + 0.001, 0.0, 0.0), radius, half / 2 - 0.001, _ALONG),
        _box(body, "wood", (0.0, 0.0, -radius - 0.009), (0.009, 0.014, 0.022)),
    )


def load_hall(robot: str = "rails") -> mujoco.MjModel:
    """Return the compiled model: seven robot joints, then nothing else; the ball is a mocap body named ``ball``."""
    spec = mujoco.MjSpec.from_string(robot_xml(robot))
    is_gantry = model_path(robot) == model_path("rails")
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    _set_up_light(spec)
    for name, finish in FINISHES.items():
        spec.add_material(
            name=name,
            rgba=finish.colour,
            specular=finish.specular,
            shininess=finish.shininess,
            reflectance=finish.reflectance,
        )
    racket = spec.geom(describe(robot).racket)
    own_parts = racket_parts(racket.parent.name, float(racket.size[0]), float(racket.size[1]))
    for geom in spec.geoms:
        dress = None if geom.name == racket.name else _DRESS.get(geom.name, "shell")
        if dress is None:
            geom.rgba = [0.0] * 4
            geom.group = 5
        else:
            geom.material, geom.rgba = dress, FINISHES[dress].colour
    # the training's net reaches from post to post as a slab; its table is too thin for a picture
    spec.geom("net").size = [0.002, NET_HALF_WIDTH, NET_HEIGHT / 2 - 0.005]
    spec.geom("net").pos = [0.0, 0.0, NET_HEIGHT / 2 - 0.005]
    spec.geom("table").size = [_L, _W, TABLE_THICKNESS / 2]
    spec.geom("table").pos = [0.0, 0.0, -TABLE_THICKNESS / 2]
    for body, of, shape, pos, size, quat in HALL_PARTS + (GANTRY_PARTS if is_gantry else ()) + own_parts:
        geom = spec.body(body).add_geom(
            type=mujoco.mjtGeom(shape),
            pos=pos,
            size=size,
            material=of,
            rgba=FINISHES[of].colour,
            contype=0,
            conaffinity=0,
            mass=0.0,
        )
        if quat is not None:
            geom.quat = quat
    _add_floor(spec)
    _add_ball(spec)
    model = spec.compile()
    model.vis.quality.offsamples = SAMPLES
    model.vis.quality.shadowsize = SHADOW_PIXELS
    # rounder than a pixel can show, and drawn in half the default's time
    model.vis.quality.numslices, model.vis.quality.numstacks, model.vis.quality.numquads = 20, 10, 2
    return model


def _set_up_light(spec: mujoco.MjSpec) -> None:
    for light in list(spec.lights):
        spec.delete(light)
    visual = spec.visual
    visual.headlight.ambient = [0.42, 0.43, 0.45]
    visual.headlight.diffuse = [0.22, 0.22, 0.22]
    visual.headlight.specular = [0.05, 0.05, 0.05]
    visual.rgba.haze = [0.16, 0.19, 0.24, 1.0]
    visual.map.znear, visual.map.zfar = 0.05, 12.0
    visual.map.shadowclip, visual.map.shadowscale = 1.0, 0.36
    visual.map.fogstart, visual.map.fogend = 3.0, 9.0
    spec.stat.extent, spec.stat.center = 2.2, [-0.3, 0.0, 0.0]
    spec.worldbody.add_light(
        pos=[-1.2, -1.9, 5.6],
        dir=[0.16, 0.33, -0.93],
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        cutoff=75.0,
        exponent=1.0,
        castshadow=True,
        diffuse=[0.85, 0.83, 0.79],
        specular=[0.35, 0.35, 0.35],
        ambient=[0.0, 0.0, 0.0],
    )
    spec.worldbody.add_light(
        pos=[2.5, 2.5, 3.5],
        dir=[-0.5, -0.5, -0.7],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=False,
        diffuse=[0.16, 0.18, 0.22],
        specular=[0.1, 0.1, 0.1],
        ambient=[0.0, 0.0, 0.0],
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.30, 0.36, 0.44],
        rgb2=[0.10, 0.12, 0.16],
        width=512,
        height=512 * 6,
    )


def _add_floor(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0.0, 0.0, FLOOR_Z],
        size=[0.0, 0.0, 0.05],
        material="floor",
        rgba=FINISHES["floor"].colour,
        contype=0,
        conaffinity=0,
    )


def _add_ball(spec: mujoco.MjSpec) -> None:
    """Add a ball of two colours, so that its spin is visible."""
    spec.add_texture(
        name="ball",
        type=mujoco.mjtTexture.mjTEXTURE_CUBE,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[1.0, 1.0, 0.97],
        rgb2=[1.0, 0.50, 0.10],
        width=64,
        height=64 * 6,
    )
    material = spec.material("ball")
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "ball"
    material.textures = textures
    body = spec.worldbody.add_body(name=BALL, mocap=True)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_RADIUS, 0.0, 0.0],
        material="ball",
        rgba=np.ones(4),
        contype=0,
        conaffinity=0,
    )
