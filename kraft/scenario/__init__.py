"""Scenarios: what a YAML file may say, what it means, and loading it."""

from kraft.scenario.geometry import Box, Circle, Obstacle, OccupancyMap, Polygon
from kraft.scenario.loader import load_scenario, parse_scenario
from kraft.scenario.model import Goal, Scenario, Start, Task
from kraft.scenario.planning import Planning, Safety
from kraft.scenario.schema import Bounds
from kraft.scenario.trial import Sensing, Trial
from kraft.scenario.truth import Truth

__all__ = [
    "Bounds",
    "Box",
    "Circle",
    "Goal",
    "Obstacle",
    "OccupancyMap",
    "Planning",
    "Polygon",
    "Safety",
    "Scenario",
    "Sensing",
    "Start",
    "Task",
    "Trial",
    "Truth",
    "load_scenario",
    "parse_scenario",
]
