"""Page about logs without an identification: paths on the floor, commands and speed over time.

The page about an identification has its colours, captions, axes, stacked panels and floor plans in common with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.plot.page import (
    DOTS,
    HEADING,
    HELD,
    LEFT,
    NOTES,
    RIGHT,
    ColouredText,
    Curve,
    Page,
    Panel,
    Rectangle,
    draw_panel,
    note_rows_of,
)
from kraft.plot.style import (
    CYCLE,
    GOAL,
    GREY,
    INK,
    LABEL,
    RULE,
    SMALL,
    WARNING,
    picture_format,
    plain_number,
    plot_style,
    shortened,
    text_width,
    write_picture,
)
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


WIDTH, HEIGHT, MAP = 11.5, 4.6, 4.0
SPEED_INTERVAL = 0.25
"""Time over which a speed is measured, s."""
LARGE, ROUND = 1000.0, 100.0
"""Coordinates from which on ticks are counted from an origin, and what the origin is a multiple of, m."""


def plot_logs(path: Path, vehicle: Vehicle, logs: Sequence[Log], problem: str) -> None:
    """Draw logs from which nothing could be identified, as PNG, SVG or PDF; `problem` is the reason.

    Raises:
        InputError: if the suffix is none of these or the file cannot be written.
    """
    picture_format(path)
    with plot_style():
        write_picture(path, compose_logs(vehicle, logs, problem))


def compose_logs(vehicle: Vehicle, logs: Sequence[Log], problem: str) -> Figure:
    """The page."""
    notes = {
        "logs": str(len(logs)),
        "driven": f"{sum(log.duration for log in logs):.0f} s",
        "poses": str(sum(len(part.pose_times) for log in logs for part in log.parts)),
    }
    rows = note_rows_of(notes, WIDTH - LEFT - RIGHT)
    top = HEADING + NOTES * len(rows) + 0.3
    floor = Rectangle(LEFT, top, MAP, HEIGHT - top - 0.45)
    page = Page(WIDTH, HEIGHT, floor, floor, (), rows)
    figure = Figure(figsize=(WIDTH, HEIGHT))
    page.heading(figure, f"{vehicle.name} · the logs", f"not identified: {problem}")
    paths = [part.poses[:, :2] for log in logs for part in log.parts]
    axes = page.axes(figure, floor)
    draw_paths(axes, paths, FITTED)
    set_floor_limits(axes, paths, floor)
    caption(figure, page, floor, (("Poses", INK), ("a dot where a drive begins", INK)))
    log = most_excited_log(logs)
    side = Rectangle(LEFT + MAP + 0.75, top, WIDTH - LEFT - MAP - 0.75 - RIGHT, floor.height)
    caption(figure, page, Rectangle(side.left, side.top - 0.14, side.width, side.height), ((log.name, INK),))
    draw_stack(figure, page, side, log_panels(vehicle, max(log.parts, key=lambda part: part.duration)))
    return figure


def log_panels(vehicle: Vehicle, part: Part) -> list[Panel]:
    """Commands, speed and yaw of a part, as logged."""
    panels = [
        Panel(
            ((f"{name}, commanded", INK),), (Curve(*held_command(part, k), {"color": INK, "linewidth": 1.0, **HELD}),)
        )
        for k, name in enumerate(vehicle.controls)
    ]
    panels.append(Panel((("speed between poses, m/s", DATA),), (Curve(*speeds(part), {"color": DATA, **DOTS}),)))
    panels.append(Panel((("yaw, rad", DATA),), (Curve(part.pose_times, part.poses[:, 2], {"color": DATA, **DOTS}),)))
    return panels


def most_excited_log(logs: Sequence[Log]) -> Log:
    """The log whose commands vary most."""
    return max(logs, key=lambda log: sum(_excitation(part) for part in log.parts))


def _excitation(part: Part) -> float:
    return float(np.sum(np.abs(np.diff(part.commands, axis=0)))) if len(part.commands) > 1 else 0.0


def held_command(part: Part, control: int) -> tuple[Floats, Floats]:
    """Times and values of a command until the last pose."""
    times = np.append(part.command_times, max(part.pose_times[-1], part.command_times[-1]))
    return times, np.append(part.commands[:, control], part.commands[-1, control])


def speeds(part: Part) -> tuple[Floats, Floats]:
    """Times and speeds along the heading between poses about `SPEED_INTERVAL` s apart, m/s."""
    times, poses = part.pose_times, part.poses
    if len(times) < 2:
        return times[:0], times[:0]
    apart = max(1, round(SPEED_INTERVAL / float(np.median(np.diff(times)))))
    apart = min(apart, len(times) - 1)
    step = poses[apart:] - poses[:-apart]
    yaw = 0.5 * (poses[apart:, 2] + poses[:-apart, 2])
    along = step[:, 0] * np.cos(yaw) + step[:, 1] * np.sin(yaw)
    return 0.5 * (times[apart:] + times[:-apart]), along / (times[apart:] - times[:-apart])


DATA: Final = "#7d8896"
FITTED: Final = INK
HELD_OUT: Final = GOAL
IDENTIFIED: Final = CYCLE  # with the identified parameters
INITIAL: Final = WARNING  # with the initial ones


def caption(figure: Figure, page: Page, part: Rectangle, words: Sequence[ColouredText]) -> None:
    """Write a caption above a part of the page, in the colours of its curves; the first text is bold."""
    left = part.left
    for k, (text, colour) in enumerate(words):
        weight = "bold" if k == 0 else "normal"
        page.text(figure, left, part.top - 0.09, text, LABEL, colour, weight=weight)
        left += (text_width(text, LABEL, bold=k == 0) + 5.5) / 72


def with_name(title: str, name: str, width: float) -> str:
    """The bold title of a caption with a name at its `{}`, which is cut where the title would exceed `width` in."""
    room = 72 * width - text_width(title.format(""), LABEL, bold=True)
    return title.format(shortened(name, LABEL, room, bold=True))


def plain_axes(axes: Axes, *, across: int = 5, along: int = 4) -> None:
    """Few ticks, plain numbers, no frame at the top and the right."""
    axes.spines[["top", "right"]].set_visible(False)
    for axis, count in ((axes.xaxis, across), (axes.yaxis, along)):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))


def draw_stack(figure: Figure, page: Page, part: Rectangle, panels: Sequence[Panel]) -> None:
    """Draw panels above each other on one time axis."""
    gap = 0.2
    height = (part.height + gap) / len(panels) - gap
    begin = min(float(curve.times[0]) for panel in panels for curve in panel.curves if len(curve.times))
    end = max(float(curve.times[-1]) for panel in panels for curve in panel.curves if len(curve.times))
    for k, panel in enumerate(panels):
        place = Rectangle(part.left, part.top + k * (height + gap), part.width, height)
        axes = page.axes(figure, place)
        plain_axes(axes, across=10, along=3)
        draw_panel(axes, panel, (begin, end), last=panel is panels[-1])
        left = place.left
        for text, colour in panel.title:
            page.text(figure, left, place.top - 0.03, text, SMALL, colour)
            left += (text_width(text, SMALL) + 6.0) / 72
    axes.set_xlabel("time, s", labelpad=1)


def draw_paths(axes: Axes, paths: Sequence[Matrix], colour: str, *, width: float = 0.9, zorder: float = 3.0) -> None:
    """Ways (n, 2) on the floor, a dot where each begins."""
    for path in paths:
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=width, solid_capstyle="round", zorder=zorder)
        axes.plot(*path[0, :2], ".", color=colour, markersize=4.0, markeredgewidth=0, zorder=zorder)


def set_floor_limits(axes: Axes, paths: Sequence[Matrix], part: Rectangle) -> None:
    """Limits that hold all ways with the same scale along both axes, m, and fill the part of the page."""
    points = np.concatenate([path[:, :2] for path in paths])
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 0.1) * 1.1
    scale = max(size[0] / part.width, size[1] / part.height)
    middle = (low + high) / 2
    half = 0.5 * scale * np.array([part.width, part.height])
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    plain_axes(axes)
    axes.set_xlabel(_from_origin(axes.xaxis, "x"), labelpad=1)
    axes.set_ylabel(_from_origin(axes.yaxis, "y"), labelpad=1)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_axisbelow(True)


def _from_origin(axis: Axis, name: str) -> str:
    """Label of an axis of coordinates; the ticks of large ones, such as UTM, are counted from an origin nearby."""
    low, high = axis.get_view_interval()
    if max(abs(low), abs(high)) < LARGE:
        return f"{name}, m"
    origin = ROUND * math.floor(low / ROUND)
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value - origin)))
    sign = "\N{MINUS SIGN}" if origin > 0 else "+"
    return f"{name} {sign} {abs(origin):,.0f}, m"


def draw_message(axes: Axes, text: str) -> None:
    """Write a text in the middle of an empty part."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=LABEL, color=GREY)
