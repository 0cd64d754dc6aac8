"""The camera of each tab: every person looks from where they like."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt
import viser

from topspin.render.film import camera_at
from topspin.render.replay import BallPath
from topspin.render.scene import CAMERAS, FIELD_OF_VIEW_DEG, Camera, CameraName

Array = npt.NDArray[np.float64]

FIRST: Final[CameraName] = "side"
_FILM_ASPECT: Final = 16 / 9
_USUAL_ASPECT: Final = 1.2  # of a window with the panel beside the scene


def eye_of(camera: Camera, aspect: float) -> tuple[Array, Array]:
    """Return a camera's position and the point that it looks at (3,) [m].

    Args:
        camera: As films have it, for pictures that are 16 wide and 9 high.
        aspect: Width of the picture by its height [-]; where it is narrower, the camera stands back.
    """
    azimuth, elevation = math.radians(camera.azimuth_deg), math.radians(camera.elevation_deg)
    flat = math.cos(elevation)
    forward = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    look_at = np.array(camera.look_at)
    return look_at - camera.distance * max(_FILM_ASPECT / aspect, 1.0) * forward, look_at


class Cameras:
    """Moves the cameras of tabs.

    Args:
        server: The page's server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._followers: set[int] = set()  # tabs whose camera moves with the ball
        first = server.initial_camera
        first.position, first.look_at = eye_of(CAMERAS[FIRST], _USUAL_ASPECT)
        first.near = 0.1  # [m] a nearer plane lets thin things flicker
        first.fov = math.radians(FIELD_OF_VIEW_DEG)

    def look_from(self, name: CameraName, client: int | None) -> None:
        """Place the camera of a tab."""
        handle = self._server.get_clients().get(-1 if client is None else client)
        if handle is None:  # it has just been closed
            return
        self._followers.discard(handle.client_id)
        if name == "follow":
            self._followers.add(handle.client_id)
        else:
            _place(handle, CAMERAS[name])

    def follow(self, path: BallPath, time: float) -> None:
        """Move the cameras that follow the ball to where it is at ``time`` [s]."""
        if not self._followers:
            return
        clients, camera = self._server.get_clients(), camera_at("follow", path, time)
        self._followers &= clients.keys()
        for number in self._followers:
            _place(clients[number], camera)


def _place(client: viser.ClientHandle, camera: Camera) -> None:
    position, look_at = eye_of(camera, client.camera.aspect)
    with client.atomic():
        client.camera.position = position
        client.camera.look_at = look_at
