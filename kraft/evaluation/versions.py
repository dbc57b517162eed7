"""Versions of everything that shapes a trial."""

from __future__ import annotations

from importlib.metadata import version

from kraft import plan_file


def versions() -> dict[str, str]:
    """Version of each: kraft, Python, planner, physics."""
    return {**plan_file.versions(), "mujoco": version("mujoco"), "scipy": version("scipy")}
