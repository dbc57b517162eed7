"""Checks that a video can be written or a window opened."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any, Final

from kraft.errors import InputError, MissingDependency
from kraft.files import check_writable
from kraft.gl import offscreen_context

INSTEAD: Final = "a video file needs no screen"


def check_video(path: Path) -> None:
    """Check before the drive that a video can be written at `path`.

    Raises:
        InputError: if its suffix is not .mp4 or nothing can be written there.
        MissingDependency: if nothing can be drawn without a window here.
    """
    if path.suffix.lower() != ".mp4":
        problem = f"ends in {path.suffix!r}" if path.suffix else "has no suffix"
        raise InputError.of(str(path), f"the video's name {problem}", "expected .mp4")
    check_writable(path)
    offscreen_context(16, 16).free()


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
