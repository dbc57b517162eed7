"""Scenario and task as plain geometry, in metres and radians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from kraft.config.source import Source
from kraft.scenario.geometry import Obstacle, Vec2
from kraft.scenario.planning import Planning
from kraft.scenario.schema import (
    Bounds,
    Sensing,
    Trial,
)  # fmt: skip
from kraft.scenario.truth import Truth


@dataclass(frozen=True)
class Start:
    """Pose (m, rad) and forward speed (m/s) at time 0."""

    x: float
    y: float
    heading: float
    speed: float = 0.0


@dataclass(frozen=True)
class Goal:
    """Goal region: a disc, and optionally a heading and limits of other components of the state; SI units.

    ``heading`` and ``heading_tolerance`` are both given or both None.
    """

    center: Vec2
    radius: float
    heading: float | None = None
    heading_tolerance: float | None = None
    limits: Mapping[str, Vec2] = field(default_factory=dict, hash=False)

    def contains(self, x: float, y: float, theta: float, components: Mapping[str, float], margin: float = 0.0) -> bool:
        """Whether a pose (m, rad) is in the region, `margin` (m) from its border, and other components in their limits.

        Limits of components without a value are not checked.
        """
        if math.hypot(x - self.center[0], y - self.center[1]) > self.radius - margin:
            return False
        if not all(low <= components.get(name, low) <= high for name, (low, high) in self.limits.items()):
            return False
        if self.heading is None or self.heading_tolerance is None:
            return True
        return abs(math.remainder(theta - self.heading, math.tau)) <= self.heading_tolerance


@dataclass(frozen=True, kw_only=True)
class Task:
    """Planning problem as the robot knows it. Code of the planner takes a `Task`, never a `Scenario`.

    ``vehicle`` is a bundled name, the path of a YAML file, or ``module:attribute``. ``source`` has the position of each
    key in the scenario file: ``task.source.where("goal.center")``.
    """

    name: str
    description: str = ""
    bounds: Bounds
    obstacles: tuple[Obstacle, ...] = ()
    start: Start
    goal: Goal
    vehicle: str = "mushr"
    planning: Planning = field(default_factory=Planning)
    source: Source = field(default_factory=Source, compare=False, repr=False)

    @property
    def obstacle_labels(self) -> list[str]:
        """What messages and pages call each obstacle: its name, or its place in the file."""
        return [obstacle.name or f"obstacles[{i}]" for i, obstacle in enumerate(self.obstacles)]


@dataclass(frozen=True, kw_only=True)
class Scenario(Task):
    """Task with the true world and the sensing, for the simulation alone."""

    truth: Truth = field(default_factory=Truth)
    sensing: Sensing = field(default_factory=Sensing)
    trial: Trial = field(default_factory=Trial)

    def task(self) -> Task:
        """Part of the scenario that the robot knows."""
        return Task(**{f.name: getattr(self, f.name) for f in fields(Task)})
