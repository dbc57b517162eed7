"""One table read as commands, poses or switch: what was found, what is missing, and which table does it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

from kraft.errors import Diagnostic, InputError
from kraft.logs.choice import Stream
from kraft.logs.mapping import Mapping
from kraft.logs.names import parse
from kraft.logs.pick import HOW, Picked, missing
from kraft.logs.table import Table
from kraft.text import suggestion

_TOPIC_HINTS: Final = {
    **dict.fromkeys(("mocap", "vicon", "vrpn", "optitrack", "qualisys", "aruco", "apriltag", "marker", "camera"), 10),
    **dict.fromkeys(("inferred", "amcl", "slam", "localization"), 5),
    **dict.fromkeys(("odom", "odometry"), -5),  # often integrated from the commands
    **dict.fromkeys(("goal", "initialpose", "target", "waypoint", "goals", "clicked"), -60),
    **dict.fromkeys(("output", "out", "muxed"), 3),  # what the vehicle was sent, rather than what someone asked for
    **dict.fromkeys(("teleop", "safety", "nav", "navigation", "input", "joy", "raw"), -3),
}


@dataclass(frozen=True)
class Attempt:
    """One table read as commands or as poses: what was found and what is missing."""

    table: Table
    time: Picked
    found: tuple[Picked, ...]

    @property
    def problems(self) -> list[Diagnostic]:
        """What is wrong: all roles that nothing fits in one, then the rest."""
        picked = (self.time, *self.found)
        roles = [one.missing for one in picked if one.missing]
        said = [one.problem for one in picked if one.problem is not None]
        return [missing(self.table, roles), *said] if roles else said

    @property
    def gaps(self) -> int:
        """How many roles have no column."""
        return sum(picked.channel is None for picked in (self.time, *self.found))

    @property
    def score(self) -> int:
        """How well the names of columns and topic fit."""
        return sum(picked.score for picked in self.found) + 10 * _hint(self.table)

    def stream(self) -> Stream:
        """What was found, of a table in which nothing is missing."""
        assert self.time.channel is not None
        return Stream(self.table, self.time.channel, tuple(p.channel for p in self.found if p.channel is not None))


def _hint(table: Table) -> int:
    return sum(_TOPIC_HINTS.get(word, 0) for word in parse(table.topic).words)


def named(tables: Sequence[Table], name: str | None, mapping: Mapping, *path: str) -> list[Table]:
    """Tables that the mapping file names at ``path``, all if it names none.

    Raises:
        InputError: if there is no such table.
    """
    if name is None:
        return list(tables)
    found = [table for table in tables if name in (table.name, table.topic, table.file)]
    if not found:
        files = ", ".join(dict.fromkeys(table.file for table in tables))
        expected = suggestion(name, [table.name for table in tables])
        raise InputError([mapping.source.diagnostic(path, f"there is no {name!r} in {files}", expected)])
    return found


def best(attempts: Sequence[Attempt], what: str) -> tuple[Stream, tuple[str, ...]]:
    """Stream of the best complete attempt, and the names of the other complete ones."""
    complete = sorted((a for a in attempts if not a.problems), key=lambda a: -a.score)
    if not complete:
        fewest = min(a.gaps for a in attempts)
        nearest = [a for a in attempts if a.gaps == fewest]
        raise InputError(chain.from_iterable(a.problems for a in nearest))
    if len(complete) > 1 and complete[0].score == complete[1].score:
        both = " and ".join(a.table.name for a in complete if a.score == complete[0].score)
        raise InputError([Diagnostic(complete[0].table.file, f"{both} both look like {what}", f"expected one; {HOW}")])
    return complete[0].stream(), tuple(a.table.name for a in complete[1:])
