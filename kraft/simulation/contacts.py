"""Contact rules: which geoms can touch (MuJoCo's contact bits), and which friction counts (its priorities).

Two geoms can touch if the type of one shares a bit with the affinity of the other. The friction of a contact is that
of the geom with the higher priority, and the larger of both at equal priority. So wheels, which have the lowest
priority, take the friction of what they stand on; a box slides by its own friction, not by that of tyres on the floor;
and a patch on the floor takes precedence over both.

A contact has as many dimensions as the geom with the higher priority asks for, and the larger number at equal priority.
So a contact of the car with an obstacle is the only one without friction, which is how a collision is detected.
The car's own friction never counts: floor, patches, bumps and boxes have higher priorities.
"""

from __future__ import annotations

from typing import Any, Final

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
