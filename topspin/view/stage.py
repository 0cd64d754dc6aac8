"""The scene in the browser: the hall, the robot, and what moves."""

from typing import Final

import numpy as np
import trimesh
import viser

from common.physics.constants import BALL_RADIUS
from topspin.render.scene import SPIN_RGB, TARGET_RGB, TRAIL
from topspin.view.picture import ESTIMATE_RGB, Picture, rgb8
from topspin.view.shapes import FLOOR_HALF, Shape, robot

BACKGROUND: Final = (0.149, 0.173, 0.212)
_FLOOR_RGB: Final = (0.22, 0.115, 0.105)  # darker than in films, whose lamp lights less of it
_TRAIL_WIDTH: Final = 0.014  # [m]
_TARGET: Final = ((0.10, 0.002, TARGET_RGB), (0.075, 0.005, (1.0, 1.0, 1.0)), (0.04, 0.008, TARGET_RGB))
_LANDING_RADIUS: Final = 0.022  # [m]
_DARK, _BRIGHT = (0.95, 0.42, 0.08), (1.0, 1.0, 0.97)  # the ball's two colours show its spin


# Fog and what lies flat under the lamp are paler here than their colours
_DEEPER: Final = np.round(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)


class Stage:
    """Draws pictures for everyone who looks.

    Args:
        server: The page's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._scene = server, server.scene
        self._name = ""
        self._set_up_light()
        self._ball = self._scene.add_mesh_trimesh("/ball", _ball_mesh(), receive_shadow=False)
        self._prediction = self._scene.add_icosphere(
            "/prediction",
            radius=1.15 * BALL_RADIUS,
            color=rgb8(ESTIMATE_RGB),
            opacity=0.55,
            cast_shadow=False,
        )
        self._target = self._scene.add_frame("/target", show_axes=False)
        for number, (radius, height, rgb) in enumerate(_TARGET):
            self._disc(f"/target/{number}", radius, height, rgb)
        self._landing = self._disc("/landing", _LANDING_RADIUS, 0.005, TRAIL[3].rgb)
        self._trails = {state: self._line(f"/trail/{state}", colour.rgb) for state, colour in TRAIL.items()}
        self._spin = self._arrow("/spin", SPIN_RGB)
        self._spin_estimate = self._arrow("/spin_estimate", ESTIMATE_RGB)

    def use_robot(self, name: str) -> None:
        """Show another robot."""
        if name == self._name:
            return
        with self._server.atomic():
            if self._name:
                self._scene.remove_by_name("/hall")
            self._name, self._robot = name, robot(name)
            self._scene.add_frame("/hall", show_axes=False)
            self._bodies = [
                self._scene.add_frame(f"/hall/{body}", show_axes=False) for body in self._robot.bodies
            ]
            for number, shape in enumerate(self._robot.shapes):
                parent = "/hall" if shape.body == "world" else f"/hall/{shape.body}"
                self._add(f"{parent}/shape{number}", shape)

    def show(self, picture: Picture) -> None:
        """Show a picture to everyone who looks."""
        positions, quaternions = self._robot.poses(picture.joints)
        with self._server.atomic():
            for body, pos, quat in zip(self._bodies, positions, quaternions, strict=True):
                body.position, body.wxyz = pos, quat
            self._ball.position, self._ball.wxyz = picture.ball_pos, picture.ball_turn
            self._target.position = np.append(picture.target, 0.0)
            for state, line in self._trails.items():
                points = picture.trail[picture.trail_states == state]
                line.visible = len(points) > 0
                if len(points):
                    line.points = points.astype(np.float32)
            self._landing.visible = picture.landing is not None
            if picture.landing is not None:
                self._landing.position = np.append(picture.landing, 0.0025)
            self._prediction.visible = picture.prediction is not None
            if picture.prediction is not None:
                self._prediction.position = picture.prediction
            for arrow, ends in ((self._spin, picture.spin), (self._spin_estimate, picture.spin_estimate)):
                arrow.visible = ends is not None
                if ends is not None:
                    arrow.points = ends[None].astype(np.float32)

    def _set_up_light(self) -> None:
        scene = self._scene
        scene.set_background_image(np.full((4, 4, 3), rgb8(BACKGROUND), np.uint8))
        scene.configure_fog(near=6.5, far=13.0, color=_deep(BACKGROUND))
        scene.configure_default_lights(enabled=False)
        scene.world_axes.visible = False
        scene.add_light_hemisphere(
            "/light/sky", sky_color=(226, 233, 245), ground_color=(105, 85, 80), intensity=1.0
        )
        scene.add_light_directional(
            "/light/lamp", intensity=1.6, cast_shadow=True, position=(-1.2, -1.9, 5.6)
        )
        scene.add_light_directional(
            "/light/fill", color=(190, 205, 235), intensity=0.3, position=(3.0, 3.0, 3.5)
        )

    def _add(self, name: str, shape: Shape) -> None:
        is_floor = shape.half == FLOOR_HALF
        colour = rgb8(_FLOOR_RGB if is_floor else shape.colour)
        opacity = None if shape.opacity == 1.0 else shape.opacity
        radius, half, third = shape.half
        if shape.form == "box":
            self._scene.add_box(
                name,
                color=colour,
                dimensions=(2.0 * radius, 2.0 * half, 2.0 * third),
                opacity=opacity,
                position=shape.pos,
                wxyz=shape.quat,
                cast_shadow=not is_floor,  # its shadow on itself would be stripes
            )
            return
        if shape.form == "cylinder":
            self._scene.add_cylinder(
                name, radius, 2.0 * half, color=colour, opacity=opacity, position=shape.pos, wxyz=shape.quat
            )
            return
        capsule = trimesh.creation.capsule(height=2.0 * half, radius=radius, count=(24, 24))
        capsule.apply_translation(-capsule.bounds.mean(axis=0))  # older releases start at one end
        self._scene.add_mesh_simple(
            name,
            vertices=capsule.vertices,
            faces=capsule.faces,
            color=colour,
            opacity=opacity,
            position=shape.pos,
            wxyz=shape.quat,
        )

    def _disc(
        self, name: str, radius: float, height: float, rgb: tuple[float, float, float]
    ) -> viser.CylinderHandle:
        return self._scene.add_cylinder(
            name, radius, height, color=_deep(rgb), position=(0.0, 0.0, height / 2), cast_shadow=False
        )

    def _line(self, name: str, rgb: tuple[float, float, float]) -> viser.LineSegmentsHandle:
        nothing = np.zeros((1, 2, 3), np.float32)
        return self._scene.add_line_segments(name, nothing, rgb8(rgb), thickness=_TRAIL_WIDTH, visible=False)

    def _arrow(self, name: str, rgb: tuple[float, float, float]) -> viser.ArrowsHandle:
        nothing, colour = np.zeros((1, 2, 3), np.float32), rgb8(rgb)
        return self._scene.add_arrows(
            name, nothing, colour, shaft_radius=0.007, head_radius=0.026, head_length=0.05, visible=False
        )


def _deep(rgb: tuple[float, float, float]) -> tuple[int, int, int]:
    """Return a colour as bytes, deeper than it is."""
    red, green, blue = (int(_DEEPER[part]) for part in rgb8(rgb))
    return red, green, blue


def _ball_mesh() -> trimesh.Trimesh:
    """Return a ball whose eight octants have two colours."""
    ball: trimesh.Trimesh = trimesh.creation.icosphere(subdivisions=4, radius=BALL_RADIUS)
    centres = ball.triangles_center
    is_dark = (centres > 0.0).sum(axis=1) % 2 == 0
    colours = np.where(is_dark[:, None], (*rgb8(_DARK), 255), (*rgb8(_BRIGHT), 255)).astype(np.uint8)
    ball.unmerge_vertices()
    ball.visual = trimesh.visual.ColorVisuals(ball, face_colors=colours)
    return ball
