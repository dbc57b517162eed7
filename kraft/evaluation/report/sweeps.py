"""Sweeps of an evaluation: shares and times of every method over the values of a varied key."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from kraft.config.overrides import value_text
from kraft.config.source import parse_path
from kraft.config.validation import lookup
from kraft.evaluation.journal import success_times
from kraft.evaluation.report.results import Cell, Results
from kraft.evaluation.statistics import mean_interval, wilson
from kraft.evaluation.summary import Result
from kraft.scenario.schema import ScenarioFile

UNIT: Final = re.compile(r"(?:^|, )(m per m/s|m/s|s|m|rad|kg|degrees)(?:$|[ ;])")
"""Unit at the end of a key's description."""


@dataclass(frozen=True)
class Estimate:
    """Share or mean with its 95 % interval, if it has one."""

    value: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Point:
    """One method at one value of the varied key.

    Attributes:
        place: position on the axis of the varied key.
        result: row of the summary.
        success, collision: share of the trials; None without trials.
        time: mean duration of the successful trials, s; None without any.
    """

    place: float
    result: Result
    success: Estimate | None
    collision: Estimate | None
    time: Estimate | None


@dataclass(frozen=True)
class Axis:
    """Axis of a varied key.

    Attributes:
        key: the dotted key.
        label: name of the quantity and its unit.
        places: position of each value; the value itself, or its number if not all values are numbers.
        texts: text of each value.
        numeric: whether all values are numbers.
    """

    key: str
    label: str
    places: tuple[float, ...]
    texts: tuple[str, ...]
    numeric: bool


@dataclass(frozen=True)
class Sweep:
    """Small multiples of one varied key; `fixed` are the values of the other varied keys.

    `panels` has the points of each method, by its name, for each entry before varying.
    """

    axis: Axis
    fixed: Mapping[str, Any]
    panels: Mapping[str, Mapping[str, Sequence[Point]]]


def sweeps(results: Results) -> list[Sweep]:
    """Sweeps of an evaluation: one for each combination of values of the varied keys but the one with most values."""
    values = varied(results)
    if not values:
        return []
    key = max(values, key=lambda name: len(values[name]))  # the first one of several
    axis = axis_of(key, values[key])
    others = [[(name, value) for value in values[name]] for name in values if name != key]
    return [_sweep(results, axis, values[key], dict(fixed)) for fixed in itertools.product(*others)]


def varied(results: Results) -> dict[str, list[Any]]:
    """Values of each varied key, in their order; a key with one value is not varied."""
    found: dict[str, list[Any]] = {}
    for cells in _bases(results).values():
        for key in cells[0].set if len(cells) > 1 else ():
            values = _distinct(cell.set.get(key) for cell in cells)
            if len(values) > 1:
                known = found.setdefault(key, [])
                known += [value for value in values if value_text(value) not in map(value_text, known)]
    return found


def axis_of(key: str, values: Sequence[Any]) -> Axis:
    """Axis of a key with its values."""
    numeric = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    places = tuple(float(value) if numeric else float(k) for k, value in enumerate(values))
    return Axis(key, label_of(key), places, tuple(value_text(value) for value in values), numeric)


def label_of(key: str, value: Any = None) -> str:
    """Name of a key's quantity with its unit, or with a value: ``delay, s``, ``delay = 0.3 s``."""
    name, unit = _quantity(key)
    if value is not None:
        return f"{name} = {value_text(value)} {unit}".rstrip()
    return f"{name}, {unit}" if unit else name


def _quantity(key: str) -> tuple[str, str]:
    """Name and unit of a key's quantity."""
    *_, name = [part for part in parse_path(key) if isinstance(part, str)] or [key]
    for ending, unit in (("_deg", "degrees"), ("_hz", "Hz")):
        if name.endswith(ending):
            return _words(name.removesuffix(ending)), unit
    found = UNIT.search(lookup(ScenarioFile, parse_path(key)).description or "")
    return _words(name), found[1] if found else ""


def settings_text(settings: Mapping[str, Any]) -> str:
    """Keys with their values in one line."""
    return ", ".join(f"{key} = {value_text(value)}" for key, value in settings.items())


def _bases(results: Results) -> dict[str, list[Cell]]:
    """Entries by their name before varying; older manifests have none."""
    found: dict[str, list[Cell]] = {}
    for cell in results.entries.values():
        found.setdefault(cell.base or cell.name, []).append(cell)
    return found


def _distinct(values: Iterator[Any]) -> list[Any]:
    return list({value_text(value): value for value in values}.values())


def _sweep(results: Results, axis: Axis, values: Sequence[Any], fixed: Mapping[str, Any]) -> Sweep:
    by_cell = results.summary.by_cell
    texts = {key: value_text(value) for key, value in fixed.items()}
    panels: dict[str, dict[str, list[Point]]] = {}
    for base, cells in _bases(results).items():
        mine = [cell for cell in cells if all(value_text(cell.set.get(key)) == text for key, text in texts.items())]
        entries = {value_text(cell.set[axis.key]): cell.name for cell in mine if axis.key in cell.set}
        places = sorted((place, entries[value_text(value)]) for place, value in zip(axis.places, values, strict=True)
                        if value_text(value) in entries)  # fmt: skip
        if places:
            panels[base] = {
                method: [
                    _point(results, place, by_cell[entry, method])
                    for place, entry in places
                    if (entry, method) in by_cell
                ]
                for method in results.methods
            }
    return Sweep(axis, fixed, panels)


def _point(results: Results, place: float, result: Result) -> Point:
    rows = results.of_cell(result.entry, result.method)
    time = None if result.t_ex is None else Estimate(result.t_ex, mean_interval(success_times(rows)))
    return Point(place, result, _share(result.success, result), _share(result.collision, result), time)


def _share(count: int, result: Result) -> Estimate | None:
    return Estimate(count / result.trials, wilson(count, result.trials)) if result.trials else None


def _words(name: str) -> str:
    return name.replace("_", " ")
