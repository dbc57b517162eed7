"""Checks of the machine for `kraft doctor`."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import kraft.matplotlib_folder  # noqa: F401  (before matplotlib)
from kraft import __version__
from kraft.config import bundled
from kraft.errors import InputError, MissingAsset, MissingDependency, out_of_range
from kraft.files import check_writable
from kraft.gl import BACKENDS
from kraft.provenance import install_command
from kraft.text import counted
from ompl_ext.cache_error import CacheError
from ompl_ext.cores import usable_cores
from ompl_ext.memory import in_words

if TYPE_CHECKING:
    from ompl_ext.old_kernels import OldKernels

MONTH: Final = 30
"""Time without use after which kernels of other versions or processors count as no longer needed, days."""

State: TypeAlias = Literal["ok", "note", "missing"]

REQUIRED: Final[dict[str, str]] = {
    "ompl": "ompl.control",
    "numpy": "numpy",
    "numba": "numba",
    "scipy": "scipy",
    "python-fcl": "fcl",
    "gtsam": "gtsam",
    "mujoco": "mujoco",
    "av": "av",
    "rosbags": "rosbags.highlevel",
    "typer": "typer",
    "rich": "rich",
    "lazy-loader": "lazy_loader",
    "pyyaml": "yaml",
    "pydantic": "pydantic",
    "matplotlib": "matplotlib",
    "pillow": "PIL",
}
"""Each required package, and the module whose import is tested."""

OPTIONAL: Final[dict[str, tuple[str, str, str]]] = {
    "distributed": ("distributed", "cluster", "spreads `kraft eval` over a Dask cluster"),
    "cyclonedds": ("cyclonedds.domain", "ros2", "`transport: {kind: ros2}` of robots"),
    "websockets": ("websockets.sync.client", "rosbridge", "`transport: {kind: rosbridge}` of robots, such as `sim`"),
    "casadi": ("casadi", "mpc", "controllers `nmpc`, as of the methods nmpc and kraft-nmpc"),
    "dynobench": (
        "dynobench",
        "dynobench",
        "judges plans in `python -m benchmarks goals` (Python 3.11 on x86-64 alone)",
    ),
    "opencv-python-headless": ("cv2", "vision", "detects tags in rendered frames (`sensing.preset: rendered`)"),
}
"""Each optional package: the module to import, the extra that installs it, and its purpose."""

_GL_TRIAL: Final = "from kraft.gl import offscreen_context; offscreen_context(16, 16)"


@dataclass(frozen=True)
class Finding:
    """Result of one check. ``note`` means that something optional is missing, or is kept and no longer needed."""

    subject: str
    state: State
    detail: str


def examine() -> list[Finding]:
    """Run all checks; this takes a few seconds, because every package is imported."""
    findings = [_python(), Finding("kraft", "ok", __version__), _files()]
    findings += [_package(name, module) for name, module in REQUIRED.items()]
    findings += [_extra(name, *use) for name, use in OPTIONAL.items()]
    return [*findings, _processor(), _cache(), *_old_kernels(), _rendering()]


def remove_kernels(days: int) -> str:
    """Remove kernels of other versions or processors that are unused for so many days; what is gone, in words.

    Raises:
        InputError: `days` is less than one.
        MissingAsset: the kernel cache cannot be used.
    """
    from ompl_ext.old_kernels import old_kernels, remove

    if problems := out_of_range("remove_kernels", days, 1):
        raise InputError(problems)
    try:
        unused = [old for old in old_kernels() if old.is_unused(days)]
    except CacheError as error:
        raise MissingAsset(str(error)) from None
    gone = remove(unused, days)
    words = f"removed {_folders(gone)} unused for {counted(days, 'day')}"
    kept = len(unused) - len(gone)
    return f"{words}; {counted(kept, 'other')} could not be removed" if kept else words


def examine_robot(name: str) -> list[Finding]:
    """Listen to a robot for a few seconds: package of its transport, publishers, subscribers, rates and clocks.

    Raises:
        InputError: if the robot file is invalid.
    """
    from kraft.robot.checklist import examine_topics
    from kraft.robot.robot_file import load_robot

    robot = load_robot(name)
    try:
        checks = examine_topics(robot)
    except (MissingDependency, InputError) as error:
        return [Finding(f"{robot.name}: transport", "missing", str(error))]
    states: dict[str, State] = {"ok": "ok", "warning": "note", "problem": "missing"}
    return [Finding(f"{robot.name}: {check.name}", states[check.state], check.detail) for check in checks]


def _python() -> Finding:
    version = platform.python_version()
    fits = (3, 11) <= sys.version_info[:2] < (3, 14)
    return Finding("python", "ok" if fits else "missing", version if fits else f"{version}; needs 3.11 to 3.13")


def _files() -> Finding:
    try:
        return Finding("bundled files", "ok", f"{len(bundled.names('scenario'))} scenarios in {bundled.root()}")
    except MissingAsset as error:
        return Finding("bundled files", "missing", str(error))


def _package(name: str, module: str) -> Finding:
    try:
        importlib.import_module(module)
        return Finding(name, "ok", importlib.metadata.version(name))
    except Exception as error:  # a shared library that does not load, an invalid setting, ...
        return Finding(name, "missing", str(error))


def _extra(name: str, module: str, extra: str, purpose: str) -> Finding:
    finding = _package(name, module)
    missing = f"not installed; {purpose}; extra {extra}: {install_command(extra)}"
    return finding if finding.state == "ok" else Finding(name, "note", missing)


def _processor() -> Finding:
    return Finding("cpu", "ok", f"{counted(usable_cores(), 'core')}, {platform.machine()}")


def _cache() -> Finding:
    """Folder of the compiled kernels, whether it can be read or written, and whether all files in it are whole."""
    from ompl_ext.kernel_cache import cache_root, check_files, layers

    try:
        root, files = cache_root(), check_files()
        folder = layers(root / "kernels" / "new")[-1].parents[1]
        check_writable(folder / "kernels" / "new")
    except CacheError as error:
        return Finding("kernel cache", "missing", str(error))
    except InputError:
        advice = "set KRAFT_CACHE_DIR to a writable folder"
        return Finding("kernel cache", "missing", f"{root.absolute()} cannot be written; {advice}")
    kept = f"{root.absolute()}, {counted(files, 'file')}"
    more = "" if folder == root else f"; it cannot be written, and what is compiled is kept in {folder}"
    return Finding("kernel cache", "ok", kept + more)


def _old_kernels() -> list[Finding]:
    """Kernels of other versions or processors, if there are any, and what removes those that are long unused."""
    from ompl_ext.old_kernels import old_kernels

    try:
        old = old_kernels()
    except CacheError:  # the finding about the cache says so
        return []
    if not old:
        return []
    unused, kept = [each for each in old if each.is_unused(MONTH)], f"{_folders(old)} of other versions or processors"
    if not unused:
        return [Finding("old kernels", "ok", kept)]
    advice = f"kraft doctor --remove-kernels {MONTH} removes {_folders(unused)} unused for {MONTH} days"
    return [Finding("old kernels", "note", f"{kept}; {advice}")]


def _folders(kernels: Sequence[OldKernels]) -> str:
    return f"{counted(len(kernels), 'folder')} ({in_words(sum(each.size for each in kernels))})"


def _rendering() -> Finding:
    """First of MuJoCo's offscreen backends that works here, tested in another process."""
    requested = os.environ.get("MUJOCO_GL")
    for backend in (requested,) if requested else BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend}
        command = [sys.executable, "-c", _GL_TRIAL]
        try:
            trial = subprocess.run(command, env=environment, capture_output=True, timeout=20, check=False)
        except subprocess.TimeoutExpired:
            continue
        if trial.returncode == 0:
            return Finding("rendering", "ok", f"MUJOCO_GL={backend}")
    tried = f"MUJOCO_GL={requested} cannot draw here, unset it" if requested else "no EGL, OSMesa or GLFW"
    return Finding(
        "rendering", "note", f"{tried}; `--video`, `--view` and rendered sensing need one of {', '.join(BACKENDS)}"
    )
