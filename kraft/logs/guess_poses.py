"""Choose the table and the columns of the poses: x, y and a yaw or an orientation."""

from __future__ import annotations

from collections.abc import Sequence

from kraft.logs.attempts import Attempt, best, named
from kraft.logs.choice import Stream
from kraft.logs.columns import POSE, axis_score, quaternion_score, yaw_score
from kraft.logs.mapping import Column, Mapping
from kraft.logs.names import parse
from kraft.logs.pick import Picked, Picker
from kraft.logs.table import Table


def guess_poses(tables: Sequence[Table], mapping: Mapping) -> tuple[Stream, tuple[str, ...]]:
    """Stream of the poses, and the names of other tables that fit.

    Raises:
        InputError: if nothing or too much fits, or the mapping file names what is not there.
    """
    found = named(tables, mapping.poses.table, mapping, "poses", "table")
    return best([pose_attempt(table, mapping) for table in found], "poses")


def pose_attempt(table: Table, mapping: Mapping) -> Attempt:
    """Read a table as poses."""
    picker, wishes = Picker(table, mapping), mapping.poses
    x = picker.pick("x", lambda name: axis_score(name, "x"), "length", ("poses", "x"), wishes.x)
    beside = _around(x, "x")
    y = picker.pick(
        "y", lambda name: _near(axis_score(name, "y"), name, "y", beside), "length", ("poses", "y"), wishes.y
    )
    yaw = picker.pick("yaw", lambda name: _near_yaw(name, beside), "angle", ("poses", "yaw"), wishes.yaw)
    quaternion = _quaternion(picker)
    whole = all(picked.channel for picked in quaternion)
    if wishes.quaternion is not None or (wishes.yaw is None and yaw.channel is None and whole):
        turn = quaternion
    else:
        turn = (yaw,)
    return Attempt(table, picker.clock(POSE, wishes.time, "poses"), (x, y, *turn))


def _around(picked: Picked, axis: str) -> tuple[str, ...]:
    """Words of a column's name without the axis: columns of one pose share them."""
    words = parse(picked.channel.column).words if picked.channel else ()
    return tuple(word for word in words if word != axis)


def _near(score: int | None, name: str, axis: str, beside: tuple[str, ...]) -> int | None:
    same = tuple(word for word in parse(name).words if word != axis) == beside
    return None if score is None else score + 50 * same


def _near_yaw(name: str, beside: tuple[str, ...]) -> int | None:
    score = yaw_score(name)
    return None if score is None else score + 12 * len(set(beside) & set(parse(name).words))


def _quaternion(picker: Picker) -> tuple[Picked, ...]:
    wishes = picker.mapping.poses.quaternion
    picked = []
    for i, axis in enumerate("xyzw"):
        wish = None if wishes is None else Column(column=wishes[i])
        found = picker.pick(f"q{axis}", lambda name, axis=axis: quaternion_score(name, axis), "control", (), None)  # type: ignore[misc]
        if wish is not None:
            found = picker.wished(f"q{axis}", wish, "control", ("poses", "quaternion", i))
        picked.append(found)
    return tuple(picked)
