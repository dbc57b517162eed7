"""Contacts: rules, and collisions of the robot with obstacles.

The rules say which geoms can touch (MuJoCo's contact bits), and which friction counts (its priorities).

Two geoms can touch if the type of one shares a bit with the affinity of the other. The friction of a contact is that
of the geom with the higher priority, and the larger of both at equal priority. So wheels, which have the lowest
priority, take the friction of what they stand on; a box slides by its own friction, not by that of tyres on the floor;
and a patch on the floor takes precedence over both.

A contact has as many dimensions as the geom with the higher priority asks for, and the larger number at equal priority.
So a contact of the car with an obstacle is the only one without friction, which is how a collision is detected.
The car's own friction never counts: floor, patches, bumps and boxes have higher priorities.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from kraft.errors import Defect
from kraft.scenario import Scenario
from kraft.simulation.floor_frame import FloorFrame

GROUND_BIT: Final = 1
OBSTACLE_BIT: Final = 2
BUMP_BIT: Final = 4
MOVABLE_BIT: Final = 8
ALL_BITS: Final = GROUND_BIT | OBSTACLE_BIT | BUMP_BIT | MOVABLE_BIT

FLOOR_PRIORITY: Final = 1
BOX_PRIORITY: Final = 2
PATCH_PRIORITY: Final = 3

CONTACT_TIME: Final = 0.01
"""Time constant of contacts, s: half of MuJoCo's own, so that wheels sink in by 0.1 mm, far less than a patch rises."""

ROWS: Final = 3
"""Rows of a contact with friction in the solver's matrix; one without friction has a single row."""

WHEEL: Final = {"contype": ALL_BITS, "conaffinity": 0, "condim": 1}
CHASSIS: Final = {"contype": OBSTACLE_BIT | BUMP_BIT | MOVABLE_BIT, "conaffinity": 0, "condim": 1}
FLOOR: Final = {"contype": 0, "conaffinity": GROUND_BIT, "priority": FLOOR_PRIORITY}
PATCH: Final = {"contype": 0, "conaffinity": GROUND_BIT, "priority": PATCH_PRIORITY}
BUMP: Final = {"contype": 0, "conaffinity": BUMP_BIT, "priority": FLOOR_PRIORITY}
OBSTACLE: Final = {"contype": 0, "conaffinity": OBSTACLE_BIT, "condim": 1}
MOVABLE: Final = {
    "contype": ALL_BITS,
    "conaffinity": MOVABLE_BIT,
    "priority": BOX_PRIORITY,
}
VISUAL: Final = {"contype": 0, "conaffinity": 0, "group": 2, "mass": 0.0}


def friction(sliding: float) -> list[float]:
    """MuJoCo's three coefficients; contacts here have three dimensions at most, so that only sliding counts."""
    return [sliding, 0.005, 0.0001]


def settings(**given: Any) -> dict[str, Any]:
    """Common contact settings of geoms that can touch, updated with `given`."""
    return {"condim": ROWS, "solref": [CONTACT_TIME, 1.0], **given}


GROUND: Final = "floor"
"""Name of the floor's body and geom."""
MAX_PENETRATION: Final = 0.001
"""Largest penetration of an ordinary contact, m."""


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
    """Detects contacts between car and obstacles in a compiled world."""

    def __init__(self, model: Any, data: Any, scenario: Scenario, frame: FloorFrame, root: str, by_rows: bool) -> None:
        self._model, self._data, self._frame = model, data, frame
        self._labels = scenario.obstacle_labels
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        self._obstacle = np.array([_index("obstacle", name) for name in names])
        self._movable = np.array([_index("movable", name) for name in names])
        self._of_car = model.body_rootid[model.geom_bodyid] == model.body(root).id
        self._solid, self._floor = self._obstacle >= 0, np.array([name == GROUND for name in names])
        self._by_rows = by_rows
        if self._by_rows and (model.neq or (model.geom_condim > ROWS).any()):
            raise Defect("contacts are counted by rows: no equality constraint, and none of more than three dimensions")

    def boxes_in_car(self) -> list[int]:
        """Indices of the movable boxes that overlap the car by more than a contact."""
        contact = self._data.contact
        deep = contact.geom[contact.dist < -MAX_PENETRATION]
        boxes = self._movable[deep[self._of_car[deep].any(axis=1)]]
        return sorted(set(boxes[boxes >= 0].tolist()))

    def overlapping_boxes(self) -> Iterator[tuple[int, str]]:
        """Each movable box in an obstacle or in an earlier movable box, by more than a contact, and the other's name.

        Boxes that sleep have no contacts yet, so distances are measured.
        """
        model, data = self._model, self._data
        for geom in np.flatnonzero(self._movable >= 0).tolist():
            box = int(self._movable[geom])
            others = np.flatnonzero(self._solid | ((self._movable >= 0) & (self._movable < box)))
            apart = np.linalg.norm(data.geom_xpos[others] - data.geom_xpos[geom], axis=1)
            near = others[apart < model.geom_rbound[others] + model.geom_rbound[geom]]
            for other in near.tolist():
                if mujoco.mj_geomDistance(model, data, geom, other, 0.0, None) < -MAX_PENETRATION:
                    is_box = self._movable[other] >= 0
                    yield (
                        box,
                        f"movable_boxes[{self._movable[other]}]" if is_box else self._labels[self._obstacle[other]],
                    )
                    break

    @property
    def depth_in_floor(self) -> float:
        """Largest depth to which the car is in the floor, m; 0 without a contact."""
        contact = self._data.contact
        on_floor = self._of_car[contact.geom].any(axis=1) & self._floor[contact.geom].any(axis=1)
        depths: list[float] = (-contact.dist[on_floor]).tolist()
        return max([0.0, *depths])

    @property
    def may_have_collision(self) -> bool:
        """Whether there may be a contact between car and obstacle, by the number of solver rows; no false negatives."""
        data = self._data
        if not self._by_rows:
            return bool(data.ncon)
        return bool(data.nefc - data.nf - data.nl != ROWS * data.ncon)

    def first(self, time: float) -> Collision | None:
        """First present contact between car and obstacle, None without one."""
        pairs = self._data.contact.geom
        car, solid = self._of_car[pairs], self._solid[pairs]
        # both geoms are checked: a movable box that is pushed against a wall touches an obstacle, too
        hits = np.flatnonzero((car[:, 0] & solid[:, 1]) | (car[:, 1] & solid[:, 0]))
        if not hits.size:
            return None
        obstacle = int(self._obstacle[pairs[hits[0]]].max())
        x, y, z = self._frame.to_floor(self._data.contact.pos[hits[0]]).tolist()
        return Collision(time, self._labels[obstacle], (x, y, z))


def _index(kind: str, geom: str) -> int:
    """Index of the obstacle or movable box that a geom belongs to, by its name "kind i ..."; -1 for another kind."""
    words = geom.split()
    return int(words[1]) if words[:1] == [kind] else -1
