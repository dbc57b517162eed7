"""Speed and controls of a plan over time, the first cycle emphasised."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from kraft.plot.panels import Curve, Panel, draw_panel, draw_title, quantity
from kraft.plot.style import CYCLE, CYCLE_FAINT, DASHED, INK, WARNING, Style
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.vehicle import Vehicle


def panels_of_plan(plan: Plan, vehicle: Vehicle, cycle: float) -> list[Panel]:
    """The speed, if the vehicle names one, and each control; the first cycle lasts `cycle` s."""
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
        panels.append(Panel(quantity(name), _plan_curves(edges, plan.controls[:, k], cycle, held=True), limits))
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
