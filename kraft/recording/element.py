"""Elements of a recommended drive: controls that are held or swept, their library, and their words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from kraft.driving.vehicle_model import VehicleModel
from kraft.recording.manoeuvres import COASTING
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

SAMPLE: Final = 0.1
"""Time between two commands of a ramp or a sine, s."""


class Driven(Protocol):
    """What gives a drive its controls, such as a `VehicleModel`."""

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle that is driven."""

    def drive_control(self, drive: float, turn: float) -> Floats:
        """Control (nu,) that drives and turns with shares of the largest ones."""


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


def in_words(elements: Sequence[Element], model: Driven) -> tuple[str, ...]:
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


def _phrase(element: Element, names: Sequence[str], model: Driven) -> str:
    first, last = model.drive_control(*element.first), model.drive_control(*element.last)
    if element.first == element.last:
        return f"{_constant(names, first)} for {element.duration:g} s"
    changing = [k for k in range(len(names)) if abs(last[k] - first[k]) > 1e-9]
    swing = f" as a sine with a period of {element.period:g} s" if element.period else " evenly"
    moved = ", ".join(f"{names[k]} {'between' if element.period else 'from'} {_told(first[k])} "
                      f"{'and' if element.period else 'to'} {_told(last[k])}" for k in changing)  # fmt: skip
    held = [k for k in range(len(names)) if k not in changing]
    constant = f", {', '.join(f'{names[k]} {_told(first[k])}' for k in held)}" if held else ""
    return f"{moved}{swing}{constant}, for {element.duration:g} s"


def _constant(names: Sequence[str], control: Floats) -> str:
    return ", ".join(f"{name} {_told(value)}" for name, value in zip(names, control.tolist(), strict=True))


def _told(value: float) -> str:
    """A control with two digits, or those before the point of a large number."""
    return f"{value + 0.0:.2g}" if abs(value) < 100.0 else f"{value:.0f}"
