"""Experiment design: the next drives, those from which the parameters follow best.

A drive is a sequence of elements: constant commands, ramps and sines.  Of all sequences that fit into the area, the one
is sought after which open-loop predictions of random drives over 1 to 3 s are expected to be best, to first order
(`kraft.sysid.information`).  The best of random sequences is improved by exchanging its elements one after another;
then follows the next drive, with what this one will have shown.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.vehicle_model import VehicleModel, model_of
from kraft.errors import Code, InputError, NegativeResult
from kraft.recording.manoeuvres import COASTING, DURATION, NAMES, REST, Manoeuvre, manoeuvre
from kraft.sysid.information import STEP, Knowledge
from ompl_ext.arrays import Floats, Matrix

ELEMENTS_MAX: Final = 6
"""Most elements of a drive: a person has to remember it."""
FIRST: Final = 150
"""Random drives among which the search begins."""
ROUNDS: Final = 2
"""Rounds of exchanges in each drive."""
BATCH: Final = 50
"""Drives that are simulated together."""
MANY: Final = 100.0
"""Times that all random drives are repeated where the noise of their poses shall not matter."""
RANDOM_DRIVES: Final = 20
"""Random drives whose prediction is to become good."""
SAMPLE: Final = 0.1
"""Time between two commands of a ramp or a sine, s."""
CHECKS: Final = 8
"""Best exchanges of an element that are tried to fit."""
PATH_STEP: Final = 0.1
"""Time between two poses whose place is checked, s."""
SHORTEST: Final = 4.0
"""Least duration of a random drive, however small the area, s."""
SHOWN: Final = 0.9
"""Standard deviation after a drive over that before, below which the drive shows a parameter."""
UNSEEN: Final = 0.9999
"""Standard deviation after a drive over that before, above which poses do not depend on a parameter."""

Room = Callable[[int, Matrix], float]
"""Time for which the predicted path (n, 3) of a drive has room, s, poses `PATH_STEP` apart; drives count from 1."""


@dataclass(frozen=True)
class Element:
    """Commands for some time, as shares of the largest drive forward (backward if negative) and turn to the left.

    Without a period they change linearly from the first to the last; with one they swing between the two as a sine.
    """

    duration: float
    first: tuple[float, float]
    last: tuple[float, float]
    period: float = 0.0


def hold(drive: float, turn: float, duration: float) -> Element:
    """Constant commands."""
    return Element(duration, (drive, turn), (drive, turn))


@dataclass(frozen=True, eq=False)
class PlannedDrive:
    """A recommended drive.

    Attributes:
        elements: what to do, from standstill.
        words: the same for a person, and how it ends.
        commands: controls of the whole drive, at rest at first and without drive at the end.
        path: (n, 3) predicted poses from the origin.
        before, after: standard deviations by parameter, expected before and after it.
        error_before, error_after: expected position error of predictions by the uncertainty of the parameters, m.
    """

    elements: tuple[Element, ...]
    words: tuple[str, ...]
    commands: Manoeuvre
    path: Matrix
    before: dict[str, float]
    after: dict[str, float]
    error_before: float
    error_after: float

    @property
    def shown(self) -> tuple[str, ...]:
        """Parameters whose standard deviation it reduces, the most reduced one first."""
        ratio = {name: self.after[name] / self.before[name] for name in self.before}
        return tuple(sorted((name for name in ratio if ratio[name] < SHOWN), key=lambda name: ratio[name]))


def planned_drives(knowledge: Knowledge, count: int, room: Room, seed: int = 0) -> Iterator[PlannedDrive]:
    """Yield the next drives, each with what those before will have shown; fewer than `count` if no other fits.

    Args:
        knowledge: what is known of the parameters now.
        count: number of drives.
        room: in the area; random drives, which count as drive 0, end where they leave it.
        seed: of the search.

    Raises:
        InputError: if every parameter is frozen.
        NegativeResult: if no drive reduces the uncertainty of any parameter.
    """
    if not knowledge.names:
        name, expected = knowledge.parameters.vehicle.name, "expected a model with parameters to identify"
        raise InputError.of(name, "has no free parameter", expected, Code.MISSING)
    search = _Search(knowledge, room, seed)
    for k in range(1, count + 1):
        drive = search.next(k)
        if drive is None:
            return
        if k == 1 and all(drive.after[name] > UNSEEN * drive.before[name] for name in drive.before):
            raise NegativeResult(f"no drive shows {', '.join(drive.before)}: poses do not depend on them")
        yield drive


class _Search:
    def __init__(self, knowledge: Knowledge, room: Room, seed: int) -> None:
        self._known, self._room = knowledge, room
        p = knowledge.parameters
        values = dict(zip(p.vehicle.parameters, p.model_values(p.nominal).tolist(), strict=False))
        self._model: VehicleModel = model_of(p.vehicle.with_parameters(values))
        self._generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0xE4])))
        self._library = library(self._model)
        drawn = np.random.Generator(np.random.PCG64(0))
        random = [manoeuvre(NAMES[k % len(NAMES)], self._model.drive_control, drawn) for k in range(RANDOM_DRIVES)]
        paths = knowledge.simulate(random).paths
        random = [_until(m, max(room(0, _coarse(p)), SHORTEST)) for m, p in zip(random, paths, strict=True)]
        self._weight = knowledge.prediction_weight(random)
        self._reference = knowledge.simulate(random).information.sum(axis=0) * MANY

    def next(self, number: int) -> PlannedDrive | None:
        """The best drive that has room; what it shows is known from then on."""
        best = self._best([self._random() for _ in range(FIRST)], math.inf, number)
        if best is None:
            return None
        for _ in range(ROUNDS):
            before = best.error
            for k in range(len(best.elements)):
                others = [(*best.elements[:k], e, *best.elements[k + 1 :]) for e in self._library]
                better = self._best([d for d in others if _fits_in_time(d)], best.error, number)
                best = better or best
            if best.error >= 0.999 * before:
                break
        known = self._known
        self._known = known.after(best.information)
        old, new = (dict(zip(known.names, k.std.tolist(), strict=True)) for k in (known, self._known))
        none = np.zeros((1, *self._reference.shape))
        errors = [float(k.uncertainty_errors(self._weight, none)[0]) for k in (known, self._known)]
        words = in_words(best.elements, self._model)
        return PlannedDrive(best.elements, words, self._commands(best.elements), best.path, old, new, *errors)

    def _random(self) -> tuple[Element, ...]:
        """Random elements until the time is used up."""
        found: list[Element] = []
        while len(found) < ELEMENTS_MAX:
            element = self._library[int(self._generator.integers(len(self._library)))]
            if not _fits_in_time((*found, element)):
                break
            found.append(element)
        return tuple(found)

    def _best(self, drives: Sequence[tuple[Element, ...]], limit: float, number: int) -> _Rated | None:
        """The best of some drives among those that fit and are better than a limit."""
        rated: list[_Rated] = []
        for k in range(0, len(drives), BATCH):
            batch = drives[k : k + BATCH]
            found = self._known.simulate([self._commands(d) for d in batch])
            known, weight = self._known, self._weight
            errors = np.hypot(
                known.uncertainty_errors(weight, found.information),
                known.model_errors(weight, self._reference, found.information),
            )
            rated += map(_Rated, errors.tolist(), batch, found.information, found.paths)
        rated.sort(key=lambda r: r.error)
        for each in rated if limit == math.inf else rated[:CHECKS]:
            if each.error >= limit:
                return None
            path = _coarse(each.path)
            if self._room(number, path) >= PATH_STEP * (len(path) - 1) - 1e-9:
                return each
        return None

    def _commands(self, elements: tuple[Element, ...]) -> Manoeuvre:
        times, controls, at, turn = [0.0], [self._model.drive_control(0.0, 0.0) + 0.0], REST, 0.0
        for element in elements:
            for since, drive, turn in sampled(element):
                times.append(at + since)
                controls.append(self._model.drive_control(drive, turn) + 0.0)  # no negative zeros in files
            at += element.duration
        times.append(at)
        controls.append(self._model.drive_control(0.0, turn) + 0.0)
        return Manoeuvre("planned", np.array(times), np.array(controls), at + COASTING)


@dataclass(frozen=True, eq=False)
class _Rated:
    error: float
    elements: tuple[Element, ...]
    information: Matrix
    path: Matrix


def _coarse(path: Matrix) -> Matrix:
    """Poses `PATH_STEP` apart of a path whose poses are `information.STEP` apart."""
    return path[:: round(PATH_STEP / STEP)]


def _until(drive: Manoeuvre, end: float) -> Manoeuvre:
    """A drive that ends before its time."""
    before = drive.times < end
    return replace(drive, times=drive.times[before], controls=drive.controls[before], end=min(end, drive.end))


def _fits_in_time(elements: Sequence[Element]) -> bool:
    return sum(e.duration for e in elements) <= DURATION - REST - COASTING + 1e-9


def sampled(element: Element) -> Iterator[tuple[float, float, float]]:
    """Time since its beginning, drive and turn of each of its commands."""
    if element.first == element.last:
        yield 0.0, *element.first
        return
    first, last = np.array(element.first), np.array(element.last)
    for k in range(round(element.duration / SAMPLE)):
        time = (k + 0.5) * SAMPLE
        share = 0.5 + 0.5 * math.sin(math.tau * time / element.period) if element.period else time / element.duration
        drive, turn = first + share * (last - first)
        yield k * SAMPLE, float(drive), float(turn)


def library(model: VehicleModel) -> tuple[Element, ...]:
    """Elements that a vehicle can drive: those backwards and with brakes only if it does so."""
    drives, turns = (0.2, 0.4, 0.6, 0.8, 1.0), (0.0, 0.3, -0.3, 0.6, -0.6, 1.0, -1.0)
    found = [hold(u, s, d) for u in drives for s in turns for d in (1.0, 2.0, 4.0)]
    found += [hold(0.0, s, d) for s in (0.0, 0.6, -0.6) for d in (1.0, 2.0)]
    for s in (0.0, 0.5, -0.5, 1.0, -1.0):
        found += [Element(d, (a, s), (b, s)) for a, b in ((0.0, 1.0), (1.0, 0.0)) for d in (4.0, 8.0)]
    found += [Element(6.0, (u, a), (u, -a)) for u in (0.3, 0.6, 1.0) for a in (1.0, -1.0)]
    found += [Element(6.0, (u, a), (u, -a), p) for u in drives[1:] for a in (0.5, 1.0) for p in (1.0, 2.0, 4.0)]
    if _reverses(model):
        found += [hold(-u, s, d) for u in (0.5, 1.0) for s in (0.0, 0.8, -0.8) for d in (2.0, 4.0)]
    if _brakes(model):
        found += [hold(-u, 0.0, d) for u in (0.3, 1.0) for d in (0.5, 1.0)]
    return tuple(found)


def _reverses(model: VehicleModel) -> bool:
    state = model.advance(np.zeros(len(model.vehicle.state)), model.drive_control(-1.0, 0.0), 2.0)
    return float(state[model.v]) < -0.02 * model.vehicle.top_speed


def _brakes(model: VehicleModel) -> bool:
    moving = model.advance(np.zeros(len(model.vehicle.state)), model.drive_control(0.8, 0.0), 2.0)
    speeds = [float(model.advance(moving, model.drive_control(u, 0.0), 0.3)[model.v]) for u in (-1.0, 0.0)]
    return speeds[0] < speeds[1] - 0.02 * model.vehicle.top_speed


TURNS: Final = np.radians(np.arange(0.0, 90.0, 5.0))
"""Headings at which a path is laid into an area."""
MARGIN_PER_METRE: Final = 0.1
"""Additional space for each metre from the start, because the vehicle deviates from its model."""


@dataclass(frozen=True)
class Area:
    """Free rectangle, m."""

    length: float
    width: float

    def holds(self, path: Matrix) -> bool:
        """Whether a path (n, 3) fits into it at some heading, with the margin."""
        long, short = max(self.length, self.width), min(self.length, self.width)
        return any(max(sides) <= long and min(sides) <= short for sides in _sides(path))

    def room(self, _: int, path: Matrix) -> float:
        """Time for which a path (n, 3) of poses `PATH_STEP` apart fits into it, s."""
        fits = bisect(range(2, len(path) + 1), 0, key=lambda n: not self.holds(path[:n]))
        return PATH_STEP * fits


def needed_area(path: Matrix) -> Area:
    """Smallest rectangle that a path (n, 3) needs, with the margin."""
    length, width = min(((max(sides), min(sides)) for sides in _sides(path)), key=math.prod)
    return Area(length, width)


def _sides(path: Matrix) -> Iterator[tuple[float, float]]:
    """Sides of the rectangle around a path at each heading, m."""
    margin = MARGIN_PER_METRE * np.hypot(path[:, 0], path[:, 1])
    for turn in TURNS:
        c, s = math.cos(turn), math.sin(turn)
        x, y = c * path[:, 0] + s * path[:, 1], c * path[:, 1] - s * path[:, 0]
        yield float(np.ptp([x + margin, x - margin])), float(np.ptp([y + margin, y - margin]))


def extent(poses: Sequence[Floats]) -> Area:
    """Rectangle along the axes that holds the poses (n, 3) of all logs."""
    both = np.concatenate([each[:, :2] for each in poses])
    length, width = (both.max(axis=0) - both.min(axis=0)).tolist()
    return Area(length, width)


def in_words(elements: Sequence[Element], model: VehicleModel) -> tuple[str, ...]:
    """What to do, one phrase for each element, from standstill to coasting."""
    names = tuple(model.vehicle.controls)
    joined: list[Element] = []
    for element in elements:
        if joined and element.first == element.last and joined[-1] == replace(element, duration=joined[-1].duration):
            joined[-1] = replace(element, duration=joined[-1].duration + element.duration)
        else:
            joined.append(element)
    found = [_phrase(element, names, model) for element in joined]
    *_, (_, _, turn) = sampled(elements[-1])  # which is held while the vehicle coasts
    return (*found, f"{_constant(names, model.drive_control(0.0, turn))} for {COASTING:g} s")


def _phrase(element: Element, names: Sequence[str], model: VehicleModel) -> str:
    first, last = model.drive_control(*element.first), model.drive_control(*element.last)
    if element.first == element.last:
        return f"{_constant(names, first)} for {element.duration:g} s"
    changing = [k for k in range(len(names)) if abs(last[k] - first[k]) > 1e-9]
    swing = f" as a sine with a period of {element.period:g} s" if element.period else " evenly"
    moved = ", ".join(f"{names[k]} {'between' if element.period else 'from'} {first[k]:.2g} "
                      f"{'and' if element.period else 'to'} {last[k]:.2g}" for k in changing)  # fmt: skip
    held = [k for k in range(len(names)) if k not in changing]
    constant = f", {', '.join(f'{names[k]} {first[k]:.2g}' for k in held)}" if held else ""
    return f"{moved}{swing}{constant}, for {element.duration:g} s"


def _constant(names: Sequence[str], control: Floats) -> str:
    return ", ".join(f"{name} {value + 0.0:.2g}" for name, value in zip(names, control.tolist(), strict=True))
