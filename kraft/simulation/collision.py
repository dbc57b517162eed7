"""Did the car touch an obstacle? Asked after every physics step, so it has to be quick when the answer is no."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kraft.errors import Defect
from kraft.scenario import Scenario
from kraft.simulation.car import CAR
from kraft.simulation.contacts import ROWS
from kraft.simulation.floor_frame import FloorFrame

MAX_PENETRATION: Final = 0.001
"""How deep things that touch are within each other at most, m."""


@dataclass(frozen=True)
class Collision:
    """First contact of the car with a static obstacle.

    Attributes:
        time: s.
        obstacle: its name in the scenario, or ``obstacles[i]``.
        point: (x, y, z) in the floor's frame, m.
    """

    time: float
    obstacle: str
    point: tuple[float, float, float]


class CollisionDetector:
    """Contacts of a compiled world, told apart."""

    def __init__(self, model: Any, data: Any, scenario: Scenario, frame: FloorFrame) -> None:
        self._data, self._frame = data, frame
        self._labels = [obstacle.name or f"obstacles[{i}]" for i, obstacle in enumerate(scenario.obstacles)]
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        self._obstacle = np.array([_index("obstacle", name) for name in names])
        self._movable = np.array([_index("movable", name) for name in names])
        self._of_car = model.body_rootid[model.geom_bodyid] == model.body(CAR).id
        self._solid = self._obstacle >= 0
        if model.neq or (model.geom_condim > ROWS).any():
            raise Defect("contacts are counted by rows: no equality constraint, and none of more than three dimensions")

    def boxes_in_car(self) -> list[int]:
        """Indices of the movable boxes that the car stands in, deeper than a contact is."""
        contact = self._data.contact
        deep = contact.geom[contact.dist < -MAX_PENETRATION]
        boxes = self._movable[deep[self._of_car[deep].any(axis=1)]]
        return sorted(set(boxes[boxes >= 0].tolist()))

    @property
    def may_have_collision(self) -> bool:
        """Whether a contact may be one between car and obstacle, by the number of rows: never wrongly False."""
        data = self._data
        return bool(data.nefc - data.nf - data.nl != ROWS * data.ncon)

    def first(self, time: float) -> Collision | None:
        """The first contact between car and obstacle at present, if there is one."""
        pairs = self._data.contact.geom
        car, solid = self._of_car[pairs], self._solid[pairs]
        # both sides: a box pushed against a wall touches something solid, too
        hits = np.flatnonzero((car[:, 0] & solid[:, 1]) | (car[:, 1] & solid[:, 0]))
        if not hits.size:
            return None
        obstacle = int(self._obstacle[pairs[hits[0]]].max())
        x, y, z = self._frame.to_floor(self._data.contact.pos[hits[0]]).tolist()
        return Collision(time, self._labels[obstacle], (x, y, z))


def _index(kind: str, geom: str) -> int:
    """Which obstacle or movable box a geom is part of, by its name "kind i ..."; -1 if it is of another kind."""
    words = geom.split()
    return int(words[1]) if words[:1] == [kind] else -1
