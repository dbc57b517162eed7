"""Experiment design: the next drives, those from which the parameters follow best.

A drive is a sequence of elements: constant commands, ramps and sines.  Of all sequences that fit into the area, the one
is sought after which open-loop predictions of random drives over 1 to 3 s are expected to be best, to first order
(`kraft.sysid.information`).  The best of random sequences is improved by exchanging its elements one after another;
then follows the next drive, with what this one will have shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Code, InputError, NegativeResult
from kraft.recording.area import PATH_STEP
from kraft.recording.element import Element, in_words, library, sampled
from kraft.recording.manoeuvres import COASTING, DURATION, NAMES, REST, Manoeuvre, manoeuvre
from kraft.sysid.information import STEP, Knowledge
from ompl_ext.arrays import Matrix
from ompl_ext.times import SAME_TIME

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
CHECKS: Final = 8
"""Best exchanges of an element that are tried to fit."""
SHORTEST: Final = 4.0
"""Least duration of a random drive, however small the area, s."""
SHOWN: Final = 0.9
"""Standard deviation after a drive over that before, below which the drive shows a parameter."""
UNSEEN: Final = 0.9999
"""Standard deviation after a drive over that before, above which poses do not depend on a parameter."""

Room = Callable[[int, Matrix], float]
"""Time for which the predicted path (n, 3) of a drive has room, s, poses `PATH_STEP` apart; drives count from 1."""


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
        random = [_until(m, max(room(0, coarse(p)), SHORTEST)) for m, p in zip(random, paths, strict=True)]
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
            path = coarse(each.path)
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


def coarse(path: Matrix) -> Matrix:
    """Poses `PATH_STEP` apart of a path whose poses are `information.STEP` apart."""
    return path[:: round(PATH_STEP / STEP)]


def _until(drive: Manoeuvre, end: float) -> Manoeuvre:
    """A drive that ends before its time."""
    before = drive.times < end
    return replace(drive, times=drive.times[before], controls=drive.controls[before], end=min(end, drive.end))


def _fits_in_time(elements: Sequence[Element]) -> bool:
    return sum(e.duration for e in elements) <= DURATION - REST - COASTING + SAME_TIME
