"""Picture of a plan: scene, tree, plan with its first cycle, and contingency."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from kraft.plot.picture import PlanPicture, compose
from kraft.plot.style import FORMATS, check_picture, picture_format, plot_style, write_picture
from kraft.scenario import Task
from ompl_ext.plan import Plan, TreeView
from ompl_ext.vehicle import Vehicle

__all__ = ["FORMATS", "check_picture", "plot_plan"]


def plot_plan(
    path: Path,
    task: Task,
    vehicle: Vehicle,
    plan: Plan | None,
    tree: TreeView,
    *,
    title: str | None = None,
    notes: Mapping[str, str] = MappingProxyType({}),
    cycle: float = 1.0,
) -> None:
    """Draw a task and the plan for it, as PNG, SVG or PDF by the suffix of `path`.

    `notes` are key figures by name, with their units.  `cycle` is the duration of the first cycle, s.  The same
    arguments give the same bytes.  The file is written in one step or not at all.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)  # before the work, not after it
    with plot_style():
        subject = PlanPicture.of(task, vehicle, plan, tree, cycle)
        write_picture(path, compose(subject, title or _title(task), notes))


def _title(task: Task) -> str:
    return f"{task.name} · {task.description}" if task.description else task.name
