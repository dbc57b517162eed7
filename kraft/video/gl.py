"""A graphics context without a window."""

from __future__ import annotations

import importlib
import os
import re
import warnings
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
    with warnings.catch_warnings(record=True) as told:  # GLFW fails by warnings, several for each call
        warnings.simplefilter("always")
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            _try_to_draw()
        except Exception as error:  # each backend and each driver fails in a way of its own
            reason = _said(told[0].message) if told else f"{type(error).__name__}: {error}"
            problem = f"{backend.upper()} cannot draw here ({reason})"
            raise MissingDependency(f"a video needs OpenGL without a window: {problem}; {_advice()}") from None
    return context


def _advice() -> str:
    return f"unset MUJOCO_GL, or {ADVICE}" if os.environ.get("MUJOCO_GL") else ADVICE


def _said(warning: Warning | str) -> str:
    """A GLFW warning, ``(number) b'text'``, without the number."""
    return re.sub(r"^\(\d+\) b?['\"](.*)['\"]$", r"\1", str(warning))


def _try_to_draw() -> None:
    """Raise what MuJoCo raises if the current context, or the lack of one, is not good enough for it."""
    mujoco: Any = importlib.import_module("mujoco")
    mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_50).free()


def _backend() -> str:
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in BACKENDS:
        return asked
    if asked:
        problem = f"MUJOCO_GL={asked} draws nothing"
        raise MissingDependency(f"a video needs OpenGL without a window: {problem}; unset it or use {BACKENDS[0]}")
    # the first import of a backend fixes it for the process, so look before
    return "osmesa" if find_library("EGL") is None and find_library("OSMesa") is not None else "egl"
