"""What is true of the robots of an evaluation, as its manifest records it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from kraft.evaluation.experiment import Cell
from kraft.trial.robot_content import robot_content
from kraft.vehicles.load import natural_robot


def robots_of(cells: Iterable[Cell]) -> Mapping[tuple[str, str], dict[str, Any]]:
    """True robot of each cell by its key: that of its scenario, else that of its planning vehicle."""
    cells = tuple(cells)
    scenarios = {cell.entry.name: cell.scenario.truth for cell in cells}
    vehicles = {cell.reference: cell.vehicle for cell in cells}
    stated = {name: robot_content(truth) for name, truth in scenarios.items() if truth.kind is not None}
    natural = {reference: robot_content(natural_robot(vehicle)[0]) for reference, vehicle in vehicles.items()}
    return {cell.key: stated.get(cell.entry.name, natural[cell.reference]) for cell in cells}
