"""OpenGL contexts without a window, and checks that a video or a window is possible."""

from __future__ import annotations

import importlib
import os
import re
import sys
import warnings
from ctypes.util import find_library
from pathlib import Path
from typing import Any, Final

from kraft.errors import InputError, MissingDependency
from kraft.files import check_writable

VIDEO_SUFFIXES: Final = (".mp4", ".webp")
INSTEAD: Final = "a video file needs no screen"
BACKENDS: Final = ("egl", "osmesa", "glfw")
ADVICE: Final = (
    "install Mesa's EGL (on Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri) or a graphics driver that has EGL, "
    "or install OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
)


def offscreen_context(width: int, height: int, purpose: str = "a video") -> Any:
    """Make a current context for pictures of up to this size (px), with the backend of `MUJOCO_GL` or an available one.

    `purpose` names in messages what needs the context.

    Raises:
        MissingDependency: with what to install or set.
    """
    backend = _backend(purpose)
    with warnings.catch_warnings(record=True) as caught:  # GLFW fails by warnings, several for each call
        warnings.simplefilter("always")
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            _try_to_draw()
        except Exception as error:  # the type depends on backend and driver
            reason = _glfw_message(caught[0].message) if caught else f"{type(error).__name__}: {error}"
            problem = f"{backend.upper()} cannot draw here ({reason})"
            raise MissingDependency(f"{purpose} needs OpenGL without a window: {problem}; {_advice()}") from None
    return context


def _advice() -> str:
    return f"unset MUJOCO_GL, or {ADVICE}" if os.environ.get("MUJOCO_GL") else ADVICE


def _glfw_message(warning: Warning | str) -> str:
    """Text of a GLFW warning, ``(number) b'text'``."""
    return re.sub(r"^\(\d+\) b?['\"](.*)['\"]$", r"\1", str(warning))


def _try_to_draw() -> None:
    """Raise MuJoCo's error if the current context is missing or insufficient."""
    mujoco: Any = importlib.import_module("mujoco")
    mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_50).free()


def _backend(purpose: str) -> str:
    requested = os.environ.get("MUJOCO_GL", "").strip().lower()
    if requested in BACKENDS:
        return requested
    if requested:
        problem = f"MUJOCO_GL={requested} draws nothing"
        raise MissingDependency(f"{purpose} needs OpenGL without a window: {problem}; unset it or use {BACKENDS[0]}")
    # the first import of a backend fixes it for the process, so it has to be available
    return "osmesa" if find_library("EGL") is None and find_library("OSMesa") is not None else "egl"


def check_video(path: Path) -> None:
    """Check before the drive that a video can be drawn, and written at `path`.

    Raises:
        InputError: if its suffix is neither .mp4 nor .webp, or nothing can be written there.
        MissingDependency: if nothing can be drawn without a window here.
    """
    check_video_file(path)
    offscreen_context(16, 16).free()


def check_video_file(path: Path) -> None:
    """Check that a video can be written at `path`, without drawing: after that no forked process could draw.

    Raises:
        InputError: if its suffix is neither .mp4 nor .webp, or nothing can be written there.
    """
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        problem = f"ends in {path.suffix!r}" if path.suffix else "has no suffix"
        raise InputError.of(str(path), f"the video's name {problem}", f"expected {' or '.join(VIDEO_SUFFIXES)}")
    check_writable(path)


def check_view() -> None:
    """Check before the drive that a window can be opened.

    Raises:
        MissingDependency: if there is no screen, or nothing to open a window with.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise MissingDependency(f"a window needs a screen, and DISPLAY is not set; {INSTEAD}")
    try:
        glfw = importlib.import_module("glfw")
        importlib.import_module("mujoco.viewer")
    except Exception as error:  # the type depends on what is missing
        raise MissingDependency(f"a window needs MuJoCo's viewer: {error}; {INSTEAD}") from error
    # the viewer opens its window in a thread and would wait forever if that failed
    if not glfw.init() or not _can_open(glfw):
        raise MissingDependency(f"a window with OpenGL cannot be opened on this screen; {INSTEAD}")


def _can_open(glfw: Any) -> bool:
    glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
    window = glfw.create_window(16, 16, "kraft", None, None)
    if window:
        glfw.destroy_window(window)
    glfw.default_window_hints()
    return bool(window)
