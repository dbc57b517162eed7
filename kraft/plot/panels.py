"""Speed and controls over time, panel under panel on one time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from kraft.plot.style import CYCLE, CYCLE_FAINT, DASHED, GREY, INK, RULE, SMALL, WARNING, Look, plain_number
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class Panel:
    """One quantity: `values` (m,) at `times` (m,), s, or held from each time to the next if `stepped`.

    `braking` is the quantity during the contingency manoeuvre, if it is known: times and values.
    """

    title: str
    times: Floats
    values: Floats
    limits: tuple[float, float]
    stepped: bool = False
    braking: tuple[Floats, Floats] | None = None


def panels_of(plan: Plan, vehicle: Vehicle) -> list[Panel]:
    """The speed, if the vehicle names one, and each control."""
    panels = []
    if vehicle.rest:
        index, safe = vehicle.rest_indices[0], plan.contingency
        speed = plan.trajectory[:, index]
        braking = None if safe is None else (safe.times, safe.states[:, index])
        low = min(0.0, float(speed.min()), *(() if braking is None else (float(braking[1].min()),)))
        limits = low, max(vehicle.top_speed, float(speed.max()))
        panels.append(Panel("speed, m/s", plan.times, speed, limits, braking=braking))
    edges = np.concatenate([[0.0], np.cumsum(plan.durations)])
    for k, (name, limits) in enumerate(vehicle.controls.items()):
        panels.append(Panel(name, edges, plan.controls[:, k], limits, stepped=True))
    return panels


def _ticks(low: float, high: float) -> list[float]:
    return [low, 0.0, high] if low < 0.0 < high else [low, high]


def draw_panel(axes: Axes, panel: Panel, cycle: float, end: float, *, last: bool) -> None:
    """Draw one panel from 0 to `end` s; the part before the end of the cycle (s) in the cycle's colour."""
    low, high = panel.limits
    room = 0.12 * (high - low)
    axes.set(xlim=(0.0, end), ylim=(low - room, high + room), yticks=_ticks(low, high))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axes.axvspan(0.0, min(cycle, end), color=CYCLE_FAINT, linewidth=0, zorder=0)
    axes.axhline(0.0, color=RULE, linewidth=0.6, zorder=1)
    times, values = panel.times, panel.values
    if panel.stepped:
        times, values = np.repeat(times, 2)[1:-1], np.repeat(values, 2)
    leaves = min(cycle, float(times[-1]))
    now = times < leaves
    joint = float(np.interp(leaves, times, values)) if not panel.stepped else float(values[now][-1])
    crowded = panel.stepped and len(panel.values) > 60
    style: Look = {"linewidth": 0.8 if crowded else 1.4, "solid_joinstyle": "miter"}
    axes.plot(np.append(leaves, times[~now]), np.append(joint, values[~now]), color=INK, **style)
    axes.plot(np.append(times[now], leaves), np.append(values[now], joint), color=CYCLE, **{**style, "linewidth": 2.2})
    if panel.braking is not None:
        axes.plot(*panel.braking, color=WARNING, linewidth=1.6, linestyle=DASHED)
    if cycle < end:
        axes.axvline(cycle, color=CYCLE, linewidth=0.9, linestyle=(0, (1, 1.2)))
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelbottom=last, bottom=last)
    title: Look = {"fontsize": SMALL + 0.5, "color": GREY, "va": "bottom", "parse_math": False}
    axes.text(0.0, 1.03, panel.title, transform=axes.transAxes, **title)
    if last:
        axes.set_xlabel("time, s", labelpad=2)
