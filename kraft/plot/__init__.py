"""Picture of a plan: scene, tree, plan with its first cycle, and contingency; key figures and curves beside them."""

from __future__ import annotations

import kraft.matplotlib_folder  # noqa: F401  (before matplotlib)

# isort: split

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from kraft.plot.labels import Label, draw_labels
from kraft.plot.page import Curve, Frame, LegendEntry, Panel, draw_legend, draw_panel, draw_title, lay_out, quantity
from kraft.plot.scene import (
    PoseTrajectory,
    draw_contingency,
    draw_goal,
    draw_obstacle,
    draw_plan,
    draw_start,
    draw_workspace,
    footprint_interval,
    outlines,
    tree_lines,
    widest_place,
)
from kraft.plot.style import (
    CYCLE,
    CYCLE_FAINT,
    DASHED,
    FORMATS,
    GOAL,
    INK,
    WARNING,
    Style,
    check_picture,
    picture_format,
    plot_style,
    write_picture,
)
from kraft.scenario import OccupancyMap, Task
from kraft.vehicles import control_title
from ompl_ext.arrays import Floats
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


@dataclass(frozen=True)
class PlanPicture:
    """Data of the picture.  `start` is the pose (3,) of the tree's root; `cycle` is in s."""

    task: Task
    vehicle: Vehicle
    plan: Plan | None
    tree: TreeView
    cycle: float
    start: Floats
    motion: PoseTrajectory | None
    contingency: PoseTrajectory | None

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, plan: Plan | None, tree: TreeView, cycle: float) -> PlanPicture:
        """Derive the motions; a tree without nodes starts where the task says."""
        start = np.array([task.start.x, task.start.y, task.start.heading])
        if len(tree.states):
            start = PoseTrajectory.of(np.zeros(1), tree.states[:1], vehicle).poses[0]
        motion = contingency = None
        if plan is not None:
            motion = PoseTrajectory.of(plan.times, plan.trajectory, vehicle)
        if plan is not None and (safe := plan.contingency) is not None:
            contingency = PoseTrajectory.of(safe.times, safe.states, vehicle)
        return cls(task, vehicle, plan, tree, cycle, start, motion, contingency)

    @property
    def warning(self) -> str | None:
        """Problem of the plan, None without one."""
        if self.plan is None:
            return "no plan"
        if not self.plan.reaches_goal:
            known = math.isfinite(self.plan.cost_to_go)
            return "goal not reached" + (f", {self.plan.cost_to_go:.1f} s or more to go" if known else "")
        return None


def compose(subject: PlanPicture, title: str, notes: Mapping[str, str]) -> Figure:
    """Compose the picture."""
    frame = Frame.around(subject.task.bounds)
    lines = tree_lines(frame, subject.tree, subject.vehicle)
    entries = _legend_entries(subject, lines)
    panels = [] if subject.plan is None else panels_of_plan(subject.plan, subject.vehicle, subject.cycle)
    page = lay_out(frame, notes, len(panels), [entry.width for entry in entries])
    figure = Figure(figsize=(page.width, page.height))
    page.heading(figure, title, subject.warning)
    _draw_map(page.axes(figure, page.map), subject, frame, lines, page.map.width / frame.size[0])
    draw_legend(figure, page, entries)
    for panel, part in zip(panels, page.panels, strict=True):
        end = max(motion.end for motion in (subject.motion, subject.contingency) if motion is not None)
        draw_plan_panel(page.axes(figure, part), panel, subject.cycle, end, last=panel is panels[-1])
    return figure


def _draw_map(axes: Axes, subject: PlanPicture, frame: Frame, lines: LineCollection | None, scale: float) -> None:
    draw_workspace(axes, frame, subject.task.bounds, scale)
    for number, obstacle in enumerate(subject.task.obstacles):
        draw_obstacle(axes, frame, obstacle, number, scale)
    if lines is not None:
        axes.add_collection(lines, autolim=False)
    draw_goal(axes, frame, subject.task.goal)
    if subject.motion is not None:
        draw_plan(axes, frame, subject.vehicle, subject.motion, subject.cycle, scale)
    if subject.contingency is not None:
        draw_contingency(axes, frame, subject.vehicle, subject.contingency, scale)
    draw_start(axes, frame, subject.vehicle, subject.start)
    draw_labels(axes, frame, _labels(subject), _avoided_points(subject), scale)


def _labels(subject: PlanPicture) -> list[Label]:
    goal = subject.task.goal
    half = subject.vehicle.footprint.width / 2
    labels = [
        Label("start", (float(subject.start[0]), float(subject.start[1])), INK, half),
        Label("goal", goal.center, GOAL, goal.radius),
    ]
    if subject.contingency is not None and subject.plan is not None and subject.plan.contingency is not None:
        safe, last = subject.plan.contingency, subject.contingency.poses[-1]
        text = f"contingency “{safe.manoeuvre}”\nstands at {subject.contingency.end:.1f} s"
        labels.append(Label(text, (float(last[0]), float(last[1])), WARNING, half))
    return labels


def _avoided_points(subject: PlanPicture) -> Floats:
    """Points (n, 3) that labels should not cover: x, y in m and a weight."""
    footprint, goal, tree = subject.vehicle.footprint, subject.task.goal, subject.tree
    turn = np.linspace(0.0, 2 * np.pi, 16)
    rim = np.array(goal.center) + goal.radius * np.column_stack([np.cos(turn), np.sin(turn)])
    bold = [rim, np.array([goal.center]), outlines(footprint, subject.start[None, :]).reshape(-1, 2)]
    for motion in (subject.motion, subject.contingency):
        if motion is not None:
            poses = motion.at(np.linspace(float(motion.times[0]), motion.end, 200))
            bold += [poses[:, :2], outlines(footprint, poses[::10]).reshape(-1, 2)]
    some = np.linspace(0, len(tree.states) - 1, min(len(tree.states), 2000)).astype(np.int64)
    places = tree.states[some][:, [subject.vehicle.index("x"), subject.vehicle.index("y")]]
    names = [widest_place(o)[0][None, :] for o in subject.task.obstacles if not isinstance(o, OccupancyMap)]
    weighted = [(points, 1.0) for points in bold] + [(places, 0.4)] + [(points, 5.0) for points in names]
    return np.vstack([np.column_stack([points, np.full(len(points), weight)]) for points, weight in weighted])


def _legend_entries(subject: PlanPicture, lines: LineCollection | None) -> list[LegendEntry]:
    entries = []
    if subject.motion is not None:
        interval = footprint_interval(subject.motion, subject.vehicle)
        entries += [
            LegendEntry(f"first cycle, {subject.cycle:g} s", "line", CYCLE, 3.6),
            LegendEntry("rest of the plan", "line", INK, 1.8),
            LegendEntry(f"vehicle every {interval:g} s", "outline", INK),
        ]
    if subject.contingency is not None:
        entries.append(LegendEntry("contingency", "dashes", WARNING, 2.5))
    if lines is not None:
        drawn, edges = len(lines.get_segments()), int((subject.tree.parents >= 0).sum())
        part = "" if drawn == edges else f" ({drawn / edges:.0%})"
        entries.append(LegendEntry(f"tree{part}: cost-to-come, s", "scale", scale=lines))
    return entries


def panels_of_plan(plan: Plan, vehicle: Vehicle, cycle: float) -> list[Panel]:
    """The speed, if the vehicle names one, and each control; the first cycle lasts `cycle` s."""
    if len(plan.durations) == 0:  # it begins in the goal
        return []
    panels = []
    if vehicle.rest:
        index, safe = vehicle.rest_indices[0], plan.contingency
        speed = plan.trajectory[:, index]
        curves = _plan_curves(plan.times, speed, cycle, held=False)
        low = min(0.0, float(speed.min()))
        if safe is not None:
            stopping = safe.states[:, index]
            low = min(low, float(stopping.min()))
            dashes: Style = {"color": WARNING, "linewidth": 1.6, "linestyle": DASHED}
            curves = (*curves, Curve(safe.times, stopping, dashes))
        limits = low, max(vehicle.top_speed, float(speed.max()))
        panels.append(Panel(quantity("speed, m/s"), curves, limits))
    edges = np.concatenate([[0.0], np.cumsum(plan.durations)])
    for k, (name, limits) in enumerate(vehicle.controls.items()):
        panels.append(
            Panel(
                quantity(control_title(vehicle, name)),
                _plan_curves(edges, plan.controls[:, k], cycle, held=True),
                limits,
            )
        )
    return panels


def _plan_curves(times: Floats, values: Floats, cycle: float, *, held: bool) -> tuple[Curve, ...]:
    """Values (m,) after the end of the cycle (s) and before it; a control is held between `times` (m + 1,)."""
    crowded = held and len(values) > 60
    style: Style = {"linewidth": 0.8 if crowded else 1.4, "solid_joinstyle": "miter"}
    if held:
        times, values = np.repeat(times, 2)[1:-1], np.repeat(values, 2)
    cycle_end = min(cycle, float(times[-1]))
    inside = times < cycle_end
    boundary = float(values[inside][-1]) if held else float(np.interp(cycle_end, times, values))
    rest = np.append(cycle_end, times[~inside]), np.append(boundary, values[~inside])
    first = np.append(times[inside], cycle_end), np.append(values[inside], boundary)
    return Curve(*rest, {**style, "color": INK}), Curve(*first, {**style, "color": CYCLE, "linewidth": 2.2})


def draw_plan_panel(axes: Axes, panel: Panel, cycle: float, end: float, *, last: bool) -> None:
    """Draw one panel from 0 to `end` s, shaded up to the end of the cycle (s)."""
    axes.axvspan(0.0, min(cycle, end), color=CYCLE_FAINT, linewidth=0, zorder=0)
    draw_panel(axes, panel, (0.0, end), last=last)
    axes.set_yticks(_ticks(*panel.limits) if panel.limits else [])
    if cycle < end:
        axes.axvline(cycle, color=CYCLE, linewidth=0.9, linestyle=(0, (1, 1.2)))
    draw_title(axes, panel.title)
    if last:
        axes.set_xlabel("time, s", labelpad=2)


def _ticks(low: float, high: float) -> list[float]:
    return [low, 0.0, high] if low < 0.0 < high else [low, high]
