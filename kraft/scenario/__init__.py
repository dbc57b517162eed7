"""Scenarios: schema of the YAML file, plain geometry, and loading.

The modules are imported when a name is first used, so that `kraft list planners` does not import numpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from kraft.scenario.geometry import Box as Box
    from kraft.scenario.geometry import Circle as Circle
    from kraft.scenario.geometry import Obstacle as Obstacle
    from kraft.scenario.geometry import OccupancyMap as OccupancyMap
    from kraft.scenario.geometry import Polygon as Polygon
    from kraft.scenario.loader import load_scenario as load_scenario
    from kraft.scenario.loader import parse_scenario as parse_scenario
    from kraft.scenario.planning import Planning as Planning
    from kraft.scenario.planning import Safety as Safety
    from kraft.scenario.scenario import Goal as Goal
    from kraft.scenario.scenario import Scenario as Scenario
    from kraft.scenario.scenario import Start as Start
    from kraft.scenario.scenario import Task as Task
    from kraft.scenario.schema import Bounds as Bounds
    from kraft.scenario.schema import Score as Score
    from kraft.scenario.schema import Sensing as Sensing
    from kraft.scenario.schema import Trial as Trial
    from kraft.scenario.truth import Truth as Truth

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "geometry": ["Box", "Circle", "Obstacle", "OccupancyMap", "Polygon"],
        "loader": ["load_scenario", "parse_scenario"],
        "planning": ["Planning", "Safety"],
        "scenario": ["Goal", "Scenario", "Start", "Task"],
        "schema": ["Bounds", "Score", "Sensing", "Trial"],
        "truth": ["Truth"],
    },
)
