"""Panels of the page of an identification: parameters, correlations, residuals, models, predictions."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kraft.plot.page import (
    DOTS,
    HELD,
    ColouredText,
    Curve,
    Page,
    Panel,
    Rectangle,
)
from kraft.plot.style import (
    GREY,
    INK,
    LABEL,
    RULE,
    SMALL,
    WARNING,
    Style,
    plain_number,
    text_width,
)
from kraft.plot.sysid_logs import (
    DATA,
    IDENTIFIED,
    INITIAL,
    draw_message,
    draw_paths,
    held_command,
    plain_axes,
    set_floor_limits,
    speeds,
)
from kraft.sysid.interface import Identification, ModelTrial, ParameterEstimate, PartFit
from kraft.sysid.prediction import error_over_time
from kraft.text import counted
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Part
    from kraft.sysid.acceptance import PredictionPair


ROW: Final = 0.215
LINE: Final = 0.145
"""Height of a small line."""
BAR: Final = 0.75
"""Least width of the bars in the table: the width of their heading."""
BETWEEN: Final = 0.12
"""Room between columns of the table."""
MATRIX, MATRIX_MAX = 2.1, 3.0
"""Least and largest side of the matrix of correlations."""
DECIMALS_MAX: Final = 7
"""Most parameters whose correlations have room for a point and two decimals."""
CELL_SHARE: Final = 0.86
"""Share of the width of a cell that its number takes at most."""
LINE_SPACE: Final = 1.6
"""Distance of turned names over the size of their letters."""
TURNED: Final = 35.0
"""Angle of names below an axis, degrees."""
FAR: Final = 10.0
"""Ratio of the largest error to the identified model's from which on errors are drawn logarithmically."""
DOWNWEIGHTED: Final = 0.5
"""Weight below which observations are marked."""


def draw_parameters(
    figure: Figure, page: Page, part: Rectangle, parameters: Mapping[str, ParameterEstimate], warnings: Sequence[str]
) -> None:
    """Draw a table of parameters, with estimate and initial value between the bounds.

    Below it are the parameters that were not estimated, in as few lines as they need, and warnings.
    """
    estimated = {name: each for name, each in parameters.items() if not each.frozen}
    rows = [("", "value", "95 % interval", "initial"), *(_cells(name, each) for name, each in estimated.items())]
    widths = [
        max(text_width(cell, LABEL, bold=column == 0) for cell in cells) / 72
        for column, cells in enumerate(zip(*rows, strict=True))
    ]
    shrunk = min(
        1.0, (part.width - BAR - BETWEEN * len(widths)) / sum(widths)
    )  # long names and remarks leave the bars their room
    left, size = part.left, shrunk * LABEL
    for column, cells in enumerate(zip(*rows, strict=True)):
        for k, cell in enumerate(cells):
            colour, weight = (GREY, "normal") if k == 0 else (INK, "normal" if column else "bold")
            page.text(figure, left, part.top + 0.12 + ROW * k, cell, size, colour, weight=weight)
        left += shrunk * widths[column] + BETWEEN
    page.text(figure, left, part.top + 0.12, "in its bounds", size, GREY)
    for k, estimate in enumerate(estimated.values(), 1):
        bar = Rectangle(left, part.top + ROW * k - 0.01, part.left + part.width - left, 0.16)
        _draw_bar(page.axes(figure, bar), estimate)
    below = part.top + 0.12 + ROW * len(rows)
    for line in _frozen_lines(parameters, part.width):
        page.text(figure, part.left, below, line, SMALL, GREY)
        below += LINE
    for k, line in enumerate(_warning_lines(warnings, part.width), 1):
        page.text(figure, part.left, below + LINE * k, line, SMALL, WARNING)


def table_height(parameters: Mapping[str, ParameterEstimate], warnings: Sequence[str], width: float) -> float:
    """Height of the table of estimated parameters with all lines below it, at a width, in."""
    below = len(_frozen_lines(parameters, width)) + len(_warning_lines(warnings, width)) + 1
    return ROW * (1 + sum(not each.frozen for each in parameters.values())) + below * LINE


def _frozen_lines(parameters: Mapping[str, ParameterEstimate], width: float) -> list[str]:
    """Lines that name the parameters that were not estimated, with their values."""
    frozen = [f"{name} {plain_number(each.value)}" for name, each in parameters.items() if each.frozen]
    return textwrap.wrap(f"frozen: {', '.join(frozen)}", _columns(width), break_on_hyphens=False) if frozen else []


def _columns(width: float) -> int:
    """Letters of a small line."""
    return int(width * 72 / (0.5 * SMALL))  # the mean width of a letter is about half its height


def _cells(name: str, estimate: ParameterEstimate) -> tuple[str, str, str, str]:
    """Cells of a row."""
    values = (estimate.value, *estimate.ci95, estimate.initial)
    value, low, high, initial = (f"{number:.{estimate.decimals}f}".replace("-", "\N{MINUS SIGN}") for number in values)
    unit = "" if estimate.unit in ("", "1") else f", {estimate.unit}"
    return f"{name}{unit}", value, f"{low} to {high}{estimate.interval_note}", initial


def _warning_lines(warnings: Sequence[str], width: float) -> list[str]:
    """Lines of the warnings."""
    return [text for warning in warnings for text in textwrap.wrap(f"Warning: {warning}", _columns(width))]


def _draw_bar(axes: Axes, estimate: ParameterEstimate) -> None:
    axes.set_axis_off()
    axes.set(xlim=(estimate.min, estimate.max), ylim=(-1, 1))
    axes.plot((estimate.min, estimate.max), (0, 0), color=RULE, linewidth=2.0, clip_on=False)
    axes.plot((estimate.initial,) * 2, (-0.8, 0.8), color=INITIAL, linewidth=1.2, clip_on=False)
    axes.plot(estimate.ci95, (0, 0), color=IDENTIFIED, linewidth=3.0, solid_capstyle="butt")
    axes.plot((estimate.value,), (0,), "o", color=IDENTIFIED, markersize=3.5, markeredgewidth=0, clip_on=False)


def matrix_side(count: int) -> float:
    """Side of the matrix of so many parameters, in: its cells are as high as the rows of the table beside it."""
    return min(max(MATRIX, ROW * count), MATRIX_MAX)


def matrix_height(names: Sequence[str]) -> float:
    """Height of the matrix with the turned names below it, in."""
    longest = max((text_width(name, SMALL) for name in names), default=0.0) / 72
    return matrix_side(len(names)) + longest * math.sin(math.radians(_turned_names(len(names)))) + 0.1


def has_hundredths(count: int) -> bool:
    """Whether the matrix of so many parameters has its numbers in hundredths, which are shorter."""
    return count > DECIMALS_MAX


def _turned_names(count: int) -> float:
    """Angle of the names below the matrix, degrees, at which lines of text do not touch each other."""
    apart = 72.0 * matrix_side(count) / max(count, 1)
    return max(TURNED, math.degrees(math.asin(min(1.0, LINE_SPACE * SMALL / apart))))


def draw_correlation(axes: Axes, names: Sequence[str], correlation: Floats) -> None:
    """The matrix, with its numbers, in axes that are a square of `matrix_side`."""
    count = len(names)
    if count == 0:
        draw_message(axes, "nothing was estimated")
        return
    axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    factor = 100.0 if has_hundredths(count) else 1.0
    cells = [[plain_number(round(100.0 * float(value)) * factor / 100.0) for value in row] for row in correlation]
    widest = max(text_width(cell, LABEL) for row in cells for cell in row)
    size = LABEL * min(1.0, 72.0 * CELL_SHARE * matrix_side(count) / count / widest)
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            colour = "white" if abs(float(correlation[i, j])) > 0.6 else INK
            axes.text(j, i, cell, ha="center", va="center", fontsize=size, color=colour)
    turned = _turned_names(count)
    axes.set_xticks(range(count), labels=list(names), rotation=turned, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(count), labels=list(names))
    axes.tick_params(length=0, labelcolor=INK)
    axes.spines[:].set_visible(False)


def fit_panels(vehicle: Vehicle, result: Identification, part: Part, fit: PartFit) -> list[Panel]:
    """Commands, speed and residuals of one part over time."""
    panels = []
    for k, name in enumerate(vehicle.controls):
        applied = Curve(fit.times[:-1], fit.controls[:, k], {"color": IDENTIFIED, "linewidth": 0.9, **HELD})
        title = ((name, INK), ("commanded", INK), ("in the fit", IDENTIFIED))
        panels.append(Panel(title, (Curve(*held_command(part, k), {"color": INK, "linewidth": 1.3, **HELD}), applied)))
    measured = Curve(*speeds(part), {"color": DATA, **DOTS})
    if vehicle.rest:
        smoothed = Curve(fit.times, fit.states[:, vehicle.rest_indices[0]], {"color": IDENTIFIED, "linewidth": 1.3})
        title = (("speed, m/s", INK), ("between poses", DATA), ("in the fit", IDENTIFIED))
        panels.append(Panel(title, (measured, smoothed)))
    return panels + _residual_panels(result, fit)


def _residual_panels(result: Identification, fit: PartFit) -> list[Panel]:
    residuals, times = fit.residuals, fit.pose_times
    downweighted = fit.weights < DOWNWEIGHTED
    position = np.hypot(residuals[:, 0], residuals[:, 1])
    curves = [
        Curve(times, 1000 * residuals[:, 0], {"color": INK, **DOTS}),
        Curve(times, 1000 * residuals[:, 1], {"color": DATA, **DOTS}),
    ]
    if downweighted.any():
        curves.append(Curve(times[downweighted], 1000 * position[downweighted], {"color": WARNING, **DOTS}))
    yaw = [Curve(times, np.degrees(residuals[:, 2]), {"color": INK, **DOTS})]
    if downweighted.any():
        yaw.append(Curve(times[downweighted], np.degrees(residuals[downweighted, 2]), {"color": WARNING, **DOTS}))
    about = (("counts less", WARNING),) if downweighted.any() else ()
    position_title = (("residual, mm", INK), ("x", INK), ("y", DATA), *about)
    yaw_title = (("residual, deg", INK), ("yaw", INK), *about)
    return [
        Panel(position_title, tuple(curves), band=2000 * result.noise.position),
        Panel(yaw_title, tuple(yaw), band=math.degrees(2 * result.noise.yaw)),
    ]


def draw_histogram(axes: Axes, residuals: Floats, sigma: float, unit: str) -> None:
    """Draw the distribution of residuals (n,) and the normal distribution of the stated noise."""
    edge = max(4.0 * sigma, float(np.quantile(np.abs(residuals), 0.995)))
    axes.hist(np.clip(residuals, -edge, edge), bins=60, range=(-edge, edge), density=True, color=DATA, alpha=0.75)
    at = np.linspace(-edge, edge, 200)
    axes.plot(at, np.exp(-0.5 * (at / sigma) ** 2) / (sigma * math.sqrt(math.tau)), color=INK, linewidth=1.2)
    plain_axes(axes)
    axes.spines["left"].set_visible(False)
    axes.set_yticks([])
    axes.set_xlim(-edge, edge)
    axes.set_xlabel(unit, labelpad=1)


def draw_trials(axes: Axes, trials: Sequence[ModelTrial]) -> list[ColouredText]:
    """Draw the errors by time of each structure, in the order in which they were tried; return the key of the times."""
    at, found = np.arange(len(trials)), list[ColouredText]()
    for share, after in enumerate(sorted({after for trial in trials for after in trial.errors})):
        colour = (DATA, INK, IDENTIFIED)[min(share, 2)]
        errors = 100.0 * np.array([trial.errors.get(after, math.nan) for trial in trials])
        for model in {trial.model: None for trial in trials}:
            own = [k for k, trial in enumerate(trials) if trial.model == model and not trial.added]
            axes.plot(at[own], errors[own], ".-", color=colour, linewidth=1.2, markersize=4.0)
        again = [k for k, trial in enumerate(trials) if trial.added]  # beside the path
        axes.plot(at[again], errors[again], ".", color=colour, markersize=4.0)
        chosen = [k for k, trial in enumerate(trials) if trial.chosen]
        axes.plot(at[chosen], errors[chosen], "o", color=colour, markersize=8.0, markerfacecolor="none")
        found.append((f"{after:g} s", colour))
    found.append(("ring: chosen", INK))
    plain_axes(axes)
    _set_logarithmic(axes, (1.0, 2.0, 5.0))
    axes.set_xticks(
        at,
        [_tried(trials, k) for k in range(len(trials))],
        rotation=TURNED,
        ha="right",
        rotation_mode="anchor",
        fontsize=SMALL,
    )
    axes.set_xlim(-0.5, len(trials) - 0.5)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_ylabel("cm", labelpad=1)
    return found


def _set_logarithmic(axes: Axes, ticks: Sequence[float]) -> None:
    """Make the vertical axis logarithmic, with ticks at these multiples of powers of ten."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10.0, ticks))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())


def trial_names_height(trials: Sequence[ModelTrial]) -> float:
    """Height of the names of the structures below their errors, which are turned, in."""
    longest = max(text_width(_tried(trials, k), SMALL) for k in range(len(trials)))
    return (longest * math.sin(math.radians(TURNED)) + SMALL) / 72 + 0.1  # and the distance to the axis


def _tried(trials: Sequence[ModelTrial], k: int) -> str:
    """What tells a structure from the one before."""
    if k == 0:
        return f"all {counted(len(trials[k].terms), 'term')} on"
    if trials[k].model != trials[k - 1].model:
        return trials[k].model
    if trials[k].added:
        return f"+ {trials[k].added}"
    names = trials[k].without.split(", ")
    return names[0] if len(names) == 1 else f"{len(names)} off together"


def longest_time(models: Sequence[ModelTrial]) -> float:
    """Longest time that any of the models predicts, s."""
    return max(after for model in models for after in model.errors)


def draw_models(axes: Axes, models: Sequence[ModelTrial]) -> None:
    """Draw the errors of models at the longest time; one that does not predict that long has no bar."""
    after = longest_time(models)
    errors = [100.0 * model.errors.get(after, math.nan) for model in models]
    colours = [IDENTIFIED if model.chosen else DATA for model in models]
    axes.barh(range(len(models)), errors, height=0.6, color=colours)
    for k, error in enumerate(errors):
        known = not math.isnan(error)
        text = plain_number(float(f"{error:.3g}")) if known else "not predicted"
        axes.text(error if known else 0.0, k, f" {text}", va="center", fontsize=SMALL)
    axes.set_yticks(range(len(models)), [model.model for model in models], fontsize=SMALL)
    axes.invert_yaxis()
    axes.set(xlim=(0.0, 1.2 * float(np.nanmax(errors))), xticks=[])
    axes.spines[["top", "right", "bottom"]].set_visible(False)


def draw_windows(axes: Axes, part: Rectangle, pair: PredictionPair, name: str) -> None:
    """Draw measured and predicted paths of each window of one log."""
    after = [window for window in pair.identified if window.log == name]
    before = [window for window in pair.initial if window.log == name]
    observed = [window.poses for window in after]
    for path in observed:
        axes.plot(path[:, 0], path[:, 1], ".", color=DATA, markersize=2.6, markeredgewidth=0, zorder=2)
    for window in before:
        axes.plot(window.predicted[:, 0], window.predicted[:, 1], color=INITIAL, linewidth=0.9, zorder=3)
    draw_paths(axes, [window.predicted for window in after], IDENTIFIED, width=1.3, zorder=4)
    set_floor_limits(axes, [*observed, *(window.predicted for window in (*after, *before))], part)


def draw_error_over_time(
    axes: Axes, pairs: Sequence[tuple[PredictionPair, str]], columns: Sequence[int], factor: float, unit: str
) -> None:
    """Draw the error over time: identified, initial, constant motion; forecasts after the first are thin and dashed.

    The axis is logarithmic where others are so large that those of the identified model would lie on the zero line.
    """
    curves: list[tuple[Floats, Floats, Style]] = []
    largest = identified = 0.0
    for k, (pair, _) in enumerate(pairs):
        style: Style = {"linewidth": 1.8 if k == 0 else 1.0, "linestyle": "solid" if k == 0 else (0, (2.4, 1.2))}
        for windows, colour in ((pair.constant, DATA), (pair.initial, INITIAL), (pair.identified, IDENTIFIED)):
            times, errors = error_over_time(windows, columns)
            curves.append((times, factor * errors, {"color": colour, **style}))
            largest = max(largest, factor * float(errors.max()))
        identified = max(identified, factor * float(errors.max()))
    far = largest > FAR * identified > 0.0
    for times, errors, drawn in curves:  # the error at the beginning, 0, is on no logarithmic axis
        axes.plot(times if far else np.append(0.0, times), errors if far else np.append(0.0, errors), **drawn)
    plain_axes(axes)
    axes.set(xlim=(0.0, 3.0))
    if far:
        _set_logarithmic(axes, (1.0,))
        unit += ", logarithmic"
    else:
        axes.set_ylim(bottom=0.0)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_xlabel("time since the prediction began, s", labelpad=1)
    axes.set_ylabel(unit, labelpad=2)
