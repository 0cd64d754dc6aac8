"""OpenGL without a display, and the canvas that MuJoCo draws on: the only file that opens a graphics library."""

import ctypes.util
import importlib
import logging
import os
import sys
from types import TracebackType
from typing import Any, Final

import mujoco
import numpy as np
import numpy.typing as npt

from common.errors import ReportedError

Image = npt.NDArray[np.uint8]

# Backend by MuJoCo's name and the library it needs; the first that is here is used. Both work without a display.
HEADLESS: Final = (("egl", "EGL"), ("osmesa", "OSMesa"))
MAX_GEOMS: Final = 6000
_WHAT_TO_INSTALL: Final = "on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri"


class RenderError(ReportedError):
    """No picture can be made here: one line with the missing part and the fix."""


def wanted(module: str) -> Any:
    """Return a library of the extra ``report``; raises RenderError where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RenderError(
            f"pictures need {module.partition('.')[0]}, which can't be imported ({error}); "
            "pip install -e '.[report]'"
        ) from None


def _open_context(width: int, height: int) -> Any:
    """Return a graphics context that is current.

    MUJOCO_GL decides, if it is set. MuJoCo reads it only at its first import, which is over by now. So the context is
    created here.
    """
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # it reports every accelerator that is missing
    requested = os.environ.get("MUJOCO_GL", "").lower()
    if sys.platform != "linux" or requested not in ("", *(name for name, _ in HEADLESS)):
        if not hasattr(mujoco, "GLContext"):
            raise RenderError(
                f"this MuJoCo can't draw with MUJOCO_GL={requested!r}; allowed: egl, osmesa or unset"
            )
        name, where = requested or "the platform's own", "mujoco"
    else:
        found = [name for name, library in HEADLESS if ctypes.util.find_library(library)]
        if not (requested or found):
            raise RenderError(
                f"pictures need OpenGL, and neither libEGL nor libOSMesa is here; {_WHAT_TO_INSTALL}"
            )
        name = requested or found[0]
        where = f"mujoco.{name}"
    try:
        context: Any = importlib.import_module(where).GLContext(width, height)
        context.make_current()
    except Exception as error:  # each backend raises its own errors, even AttributeError
        first = (str(error).splitlines() or [type(error).__name__])[0]
        others = [other for other, _ in HEADLESS if other != name]
        raise RenderError(
            f"no graphics context by {name}: {first}; {_WHAT_TO_INSTALL}, or set MUJOCO_GL={others[0]}"
        ) from None
    return context


class Canvas:
    """A buffer that a model is drawn in; close it, or use it in a ``with``.

    Args:
        model: What is drawn; its off-screen buffer is made as large as the picture.
        width: Picture's width [pixels].
        height: Picture's height [pixels].
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self.width, self.height = width, height
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl = _open_context(width, height)
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:  # a context that draws nothing, as GLFW's without a display
            raise RenderError(
                f"nothing can be drawn: {error}; {_WHAT_TO_INSTALL}, and unset MUJOCO_GL"
            ) from None
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self.scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)

    def paint(self, width: int, height: int) -> Image:
        """Return the scene as a picture (height, width, 3), no larger than the canvas."""
        self._gl.make_current()
        rectangle = mujoco.MjrRect(0, 0, width, height)
        upside_down = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rectangle, self.scene, self._context)
        mujoco.mjr_readPixels(upside_down, None, rectangle, self._context)
        return upside_down[::-1].copy()

    def close(self) -> None:
        """Free the graphics memory."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
