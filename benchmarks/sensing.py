"""Errors of rendered frames, and of the preset that stands for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from benchmarks.sensing_drives import Errors, drive, stand
from kraft.scenario import Scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.camera import Camera, MarkerCamera
from kraft.simulation.rendered_camera import RenderedCamera
from ompl_ext.arrays import Floats, Matrix

DRIVE, STAND = 10.0, 4.0  # s
DISTANCES = ((4.7, 5.0), (5.0, 5.4), (5.4, 6.2))  # m
LAGS = (1, 3, 6, 15, 30, 60, 90)  # frames at 30 Hz
PLACES = ((-1.0, 1.5), (1.5, 3.5), (3.5, 6.0))  # y, m
UNITS = np.array([1000.0, 1000.0, math.degrees(1.0)])
RESAMPLES = 200
NOTES = (
    "Errors along and across the line of sight (mm) and of the heading (deg); in brackets 95 % intervals by",
    "resampling whole drives. Spread and autocorrelation are about zero, bias is the mean of all frames: subtracting",
    "the mean of each drive would hide the part of the error that is constant in a drive.",
)


def run(effort: Effort) -> Report:
    """Drives and cars that stand, with the rendered camera and with the preset."""
    rows: list[Row] = []
    tables: dict[str, list[list[str]]] = {}
    for motion, measure, count, seconds in (("moving", drive, 1, DRIVE), ("standing", stand, 3, STAND)):
        found = {
            name: [measure(k, seconds, make) for k in range(count * effort.seeds)]
            for name, make in (("rendered", _rendered), ("single-tag", _preset))
        }
        times = [1000.0 * errors.seconds for errors in found["rendered"]]
        rows.append(row(f"{motion}: time of a rendered frame", "ms", times, Target(15.0)))
        for name, drives in found.items():
            missed = [100.0 * float(np.isnan(errors.error[:, 0]).mean()) for errors in drives]
            rows.append(row(f"{motion}, {name}: frames without a detection", "%", [float(np.mean(missed))]))
        tables[f"{motion}: spread"] = _table(found, "distance (m)", DISTANCES, lambda e: e.distance, _spread)
        tables[f"{motion}: bias"] = _table(found, "y (m)", PLACES, lambda e: e.place[:, 1], _bias)
        tables[f"{motion}: autocorrelation"] = _correlations(found)
    return Report("sensing", rows, tables, list(NOTES))


def _rendered(scenario: Scenario, seed: int) -> Camera:
    return RenderedCamera(scenario, seed)


def _preset(scenario: Scenario, seed: int) -> Camera:
    return MarkerCamera(scenario.sensing, MARKER_HEIGHT, seed)


def _spread(drives: Sequence[Matrix]) -> Floats:
    """Root mean square (3,) of the errors (n, 3) of some drives."""
    spread: Floats = np.sqrt(np.nanmean(np.concatenate(drives) ** 2, axis=0)) * UNITS
    return spread


def _bias(drives: Sequence[Matrix]) -> Floats:
    bias: Floats = np.nanmean(np.concatenate(drives), axis=0) * UNITS
    return bias


def autocorrelation(drives: Sequence[Matrix], lag: int) -> Floats:
    """Autocorrelation (3,) about zero at a lag in frames; frames without a detection are left out."""
    products = np.concatenate([errors[:-lag] * errors[lag:] for errors in drives])
    found: Floats = np.nanmean(products, axis=0) / np.nanmean(np.concatenate(drives) ** 2, axis=0)
    return found


def _table(
    found: dict[str, list[Errors]], what: str, ranges: Sequence[tuple[float, float]],
    value: Callable[[Errors], Floats], statistic: Callable[[Sequence[Matrix]], Floats],
) -> list[list[str]]:  # fmt: skip
    table = [[what, "camera", "along", "across", "heading"]]
    for low, high in (*ranges, (-math.inf, math.inf)):
        for name, drives in found.items():
            some = [e.error[(value(e) >= low) & (value(e) < high)] for e in drives]
            label = f"{low:g} to {high:g}" if math.isfinite(low) else "all"
            table.append([label, name, *_with_intervals([part for part in some if len(part)], statistic)])
    return table


def _correlations(found: dict[str, list[Errors]]) -> list[list[str]]:
    table = [["lag (s)", "camera", "along", "across", "heading"]]
    for lag in LAGS:
        for name, drives in found.items():
            some = [e.error for e in drives if len(e.error) > lag]
            cells = _with_intervals(some, lambda parts, lag=lag: autocorrelation(parts, lag))  # type: ignore[misc]
            table.append([f"{lag / 30:.3g}", name, *cells])
    return table


def _with_intervals(drives: list[Matrix], statistic: Callable[[Sequence[Matrix]], Floats]) -> list[str]:
    """A statistic of drives, each of its three numbers with a 95 % interval."""
    if not drives:
        return ["-", "-", "-"]
    generator = np.random.default_rng(0)
    picks = generator.integers(len(drives), size=(RESAMPLES, len(drives)))
    low, high = np.quantile([statistic([drives[k] for k in pick]) for pick in picks], [0.025, 0.975], axis=0)
    whole = statistic(drives)
    return [f"{value:.3g} ({a:.3g} to {b:.3g})" for value, a, b in zip(whole, low, high, strict=True)]
