"""A graphics context without a window."""

from __future__ import annotations

import importlib
import os
from ctypes.util import find_library
from typing import Any, Final

from kraft.errors import MissingDependency

BACKENDS: Final = ("egl", "osmesa", "glfw")
ADVICE: Final = (
    "install Mesa's EGL (on Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri) or a graphics driver that has EGL, "
    "or install OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
)


def offscreen_context(width: int, height: int) -> Any:
    """A current context for pictures of up to this size, px, by what `MUJOCO_GL` says or by what there is.

    Raises:
        MissingDependency: with what to install or set.
    """
    backend = _backend()
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # each backend and each driver fails in a way of its own
        problem = f"{backend.upper()} cannot draw here ({type(error).__name__}: {error})"
        raise MissingDependency(f"a video needs OpenGL without a window: {problem}; {ADVICE}") from error
    return context


def _backend() -> str:
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in BACKENDS:
        return asked
    if asked:
        problem = f"MUJOCO_GL={asked} draws nothing"
        raise MissingDependency(f"a video needs OpenGL without a window: {problem}; unset it or use {BACKENDS[0]}")
    # the first import of a backend fixes it for the process, so look before
    return "osmesa" if find_library("EGL") is None and find_library("OSMesa") is not None else "egl"
