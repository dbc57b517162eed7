"""Choice of tables and columns for commands, poses and dead man: by the mapping file, else by their names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final, TypeVar

from kraft.config.source import KeyPath
from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.mapping import Column, Mapping
from kraft.logs.matching import MAPPING_HINT, ColumnMatch, ColumnMatcher, missing_columns
from kraft.logs.names import (
    COMMAND,
    POSE,
    axis_score,
    control_score,
    dead_man_score,
    parse,
    quaternion_score,
    yaw_score,
)
from kraft.logs.streams import Channel, Choice, Stream
from kraft.logs.table import LOG_TIME, Table
from kraft.text import suggestion

Guess = TypeVar("Guess")
_WANTED: Final = ("goal", "goals", "waypoint", "waypoints", "initialpose", "clicked")
"""Words of topics with poses that somebody wants or states: no vehicle was observed there."""
_TOPIC_HINTS: Final = {
    **dict.fromkeys(("mocap", "vicon", "vrpn", "optitrack", "qualisys", "aruco", "apriltag", "marker", "camera"), 10),
    **dict.fromkeys(("inferred", "amcl", "slam", "localization"), 5),
    **dict.fromkeys(("odom", "odometry"), -5),  # often integrated from the commands
    **dict.fromkeys((*_WANTED, "target"), -60),
    **dict.fromkeys(("output", "out", "muxed"), 3),  # commands to the vehicle, rather than inputs of a multiplexer
    **dict.fromkeys(("teleop", "safety", "nav", "navigation", "input", "joy", "raw"), -3),
}
DEAD_MAN_SWITCH = "the dead-man switch"


@dataclass(frozen=True)
class TableMatch:
    """Match of one table as commands, poses or dead man: found and missing columns."""

    table: Table
    time: ColumnMatch
    found: tuple[ColumnMatch, ...]

    @property
    def problems(self) -> list[Diagnostic]:
        """Problems: one for all roles without a column, then the others."""
        matches = (self.time, *self.found)
        roles = [one.missing for one in matches if one.missing]
        problems = [one.problem for one in matches if one.problem is not None]
        return [missing_columns(self.table, roles), *problems] if roles else problems

    @property
    def missing_count(self) -> int:
        """Number of roles without a column."""
        return sum(picked.channel is None for picked in (self.time, *self.found))

    @property
    def score(self) -> int:
        """Score of the names of the columns and the topic."""
        return sum(picked.score for picked in self.found) + 10 * _topic_score(self.table)

    def stream(self) -> Stream:
        """Stream of the matched columns, if none is missing."""
        assert self.time.channel is not None
        return Stream(self.table, self.time.channel, tuple(p.channel for p in self.found if p.channel is not None))


def choose(tables: Sequence[Table], controls: Sequence[str], mapping: Mapping) -> Choice:
    """Choose the streams of a log.

    Raises:
        InputError: with every role without a match or with several equal ones.
    """
    problems: list[Diagnostic] = []
    commands = _collect(lambda: guess_commands(tables, controls, mapping), problems)
    poses = _collect(lambda: guess_poses(tables, mapping), problems)
    switch = _collect(lambda: guess_dead_man(tables, mapping), problems)
    if commands is None or poses is None or switch is None:
        raise InputError(problems)
    unused = (*commands[1], *poses[1], *switch[1])
    return Choice(commands[0], poses[0], switch[0], tuple(dict.fromkeys(unused)))


def offers(table: Table, controls: Sequence[str], mapping: Mapping) -> tuple[bool, bool]:
    """Whether a table has all commands, and whether it has poses, regardless of the clock."""
    commands = match_commands(table, controls, mapping).found
    poses = match_poses(table, mapping).found
    names = (None, table.name, table.file)
    return (
        mapping.commands.table in names and all(picked.channel for picked in commands),
        mapping.poses.table in names and all(picked.channel for picked in poses),
    )


def _collect(guess: Callable[[], Guess], problems: list[Diagnostic]) -> Guess | None:
    """The guess, or None with its problems added to ``problems``, so that those of all guesses are raised together."""
    try:
        return guess()
    except InputError as error:
        problems += error.diagnostics
        return None


def _topic_score(table: Table) -> int:
    return sum(_TOPIC_HINTS.get(word, 0) for word in parse(table.topic).words)


def named_tables(tables: Sequence[Table], name: str | None, mapping: Mapping, *path: str) -> list[Table]:
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
        raise InputError(
            [mapping.source.diagnostic(path, f"there is no {name!r} in {files}", expected, code=Code.UNKNOWN)]
        )
    return found


def best_match(matches: Sequence[TableMatch], what: str) -> tuple[Stream, tuple[str, ...]]:
    """Stream of the best complete attempt, and the names of the other complete ones."""
    complete = sorted((a for a in matches if not a.problems), key=lambda a: -a.score)
    if not complete:
        fewest = min(a.missing_count for a in matches)
        nearest = [a for a in matches if a.missing_count == fewest]
        raise InputError(chain.from_iterable(a.problems for a in nearest))
    if len(complete) > 1 and complete[0].score == complete[1].score:
        both = " and ".join(a.table.name for a in complete if a.score == complete[0].score)
        raise InputError(
            [
                Diagnostic(
                    complete[0].table.file,
                    f"{both} match {what} equally well",
                    f"expected one; {MAPPING_HINT}",
                    code=Code.CONFLICT,
                )
            ]
        )
    return complete[0].stream(), tuple(a.table.name for a in complete[1:])


def guess_commands(
    tables: Sequence[Table], controls: Sequence[str], mapping: Mapping
) -> tuple[tuple[Stream, ...], tuple[str, ...]]:
    """Streams that together have every control once, and the names of other matching tables.

    Raises:
        InputError: without a match or with several equal ones, or if the mapping file names what does not exist.
    """
    if unknown := unknown_controls(controls, mapping):
        raise InputError(unknown)
    apart = {
        name: mapped_column.table
        for name, mapped_column in mapping.commands.controls.items()
        if mapped_column.table is not None
    }
    streams = []
    for name, at in apart.items():
        found = named_tables(tables, at, mapping, "commands", "controls", name, "table")
        streams.append(best_match([match_commands(table, [name], mapping) for table in found], "commands")[0])
    rest = [name for name in controls if name not in apart]
    unused: tuple[str, ...] = ()
    if rest:
        found = named_tables(tables, mapping.commands.table, mapping, "commands", "table")
        stream, unused = best_match([match_commands(table, rest, mapping) for table in found], "commands")
        streams.insert(0, stream)
    return tuple(streams), unused


def match_commands(table: Table, controls: Sequence[str], mapping: Mapping) -> TableMatch:
    """Match a table as commands of these controls."""
    matcher = ColumnMatcher(table, mapping)
    time = matcher.clock(COMMAND, mapping.commands.time, "commands")
    return TableMatch(table, time, tuple(_control(matcher, name) for name in controls))


def unknown_controls(controls: Sequence[str], mapping: Mapping) -> list[Diagnostic]:
    """Controls that the mapping file names, for a column or the dead man, and that the vehicle does not have."""
    masks = mapping.dead_man.masks or () if mapping.dead_man else ()
    named: list[tuple[KeyPath, str, bool]] = [
        *((("commands", "controls", name), name, True) for name in mapping.commands.controls),
        *((("dead_man", "masks", i), name, False) for i, name in enumerate(masks)),
    ]
    return [
        mapping.source.diagnostic(
            path,
            "is not a control of the vehicle" if at_key else f"{name!r} is not a control of the vehicle",
            suggestion(name, controls),
            at_key=at_key,
            code=Code.UNKNOWN,
        )
        for path, name, at_key in named
        if name not in controls
    ]


def _control(matcher: ColumnMatcher, name: str) -> ColumnMatch:
    mapped_column = matcher.mapping.commands.controls.get(name)
    picked = matcher.match(
        name, lambda column: control_score(column, name), "control", ("commands", "controls", name), mapped_column
    )
    if (
        mapped_column is None
        and picked.channel is not None
        and parse(picked.channel.column).words[-2:] == ("angular", "z")
    ):
        note = "a turning rate by convention, used as the steering command"
        return ColumnMatch(Channel(name, picked.channel.column, "1", note=note), picked.score)
    return picked


def guess_poses(tables: Sequence[Table], mapping: Mapping) -> tuple[Stream, tuple[str, ...]]:
    """Stream of the poses, and the names of other matching tables.

    Raises:
        InputError: without a match or with several equal ones, or if the mapping file names what does not exist.
    """
    named = mapping.poses.table
    found = named_tables(tables, named, mapping, "poses", "table")
    stream, others = best_match([match_poses(table, mapping) for table in found], "poses")
    if named is None and set(_WANTED) & set(parse(stream.table.topic).words):
        problem = f"has no poses but those of {stream.table.topic}, which by its name are not where the vehicle was"
        expected = "expected observed poses; if they are, a mapping file can name the topic as `table` of `poses`"
        raise InputError([Diagnostic(stream.table.file, problem, expected, code=Code.MISSING)])
    return stream, others


def match_poses(table: Table, mapping: Mapping) -> TableMatch:
    """Match a table as poses."""
    matcher, mapped_columns = ColumnMatcher(table, mapping), mapping.poses
    x = matcher.match("x", lambda name: axis_score(name, "x"), "length", ("poses", "x"), mapped_columns.x)
    beside = _around(x, "x")
    y = matcher.match(
        "y", lambda name: _near(axis_score(name, "y"), name, "y", beside), "length", ("poses", "y"), mapped_columns.y
    )
    yaw = matcher.match("yaw", lambda name: _near_yaw(name, beside), "angle", ("poses", "yaw"), mapped_columns.yaw)
    quaternion = _quaternion(matcher)
    whole = all(picked.channel for picked in quaternion)
    if mapped_columns.quaternion is not None or (mapped_columns.yaw is None and yaw.channel is None and whole):
        turn = quaternion
    else:
        turn = (yaw,)
    return TableMatch(table, matcher.clock(POSE, mapped_columns.time, "poses"), (x, y, *turn))


def _around(picked: ColumnMatch, axis: str) -> tuple[str, ...]:
    """Words of a column name without the axis, which columns of one pose share."""
    words = parse(picked.channel.column).words if picked.channel else ()
    return tuple(word for word in words if word != axis)


def _near(score: int | None, name: str, axis: str, beside: tuple[str, ...]) -> int | None:
    same = tuple(word for word in parse(name).words if word != axis) == beside
    return None if score is None else score + 50 * same


def _near_yaw(name: str, beside: tuple[str, ...]) -> int | None:
    score = yaw_score(name)
    return None if score is None else score + 12 * len(set(beside) & set(parse(name).words))


def _quaternion(matcher: ColumnMatcher) -> tuple[ColumnMatch, ...]:
    mapped_columns = matcher.mapping.poses.quaternion
    picked = []
    for i, axis in enumerate("xyzw"):
        mapped_column = None if mapped_columns is None else Column(column=mapped_columns[i])
        found = matcher.match(f"q{axis}", lambda name, axis=axis: quaternion_score(name, axis), "control", (), None)  # type: ignore[misc]
        if mapped_column is not None:
            found = matcher.mapped(f"q{axis}", mapped_column, "control", ("poses", "quaternion", i))
        picked.append(found)
    return tuple(picked)


def guess_dead_man(tables: Sequence[Table], mapping: Mapping) -> tuple[Stream | None, tuple[str, ...]]:
    """Stream of the switch, None if no column matches, and the matching columns of other tables.

    Raises:
        InputError: with several equal matches, or if the mapping file names what does not exist.
    """
    mapped_column = mapping.dead_man
    found = named_tables(tables, mapped_column.table if mapped_column else None, mapping, "dead_man", "table")
    matches = [_match_switch(table, mapping) for table in found]
    if mapped_column is not None:
        return best_match(matches, DEAD_MAN_SWITCH)
    fitting = [each for each in matches if not each.found[0].missing]
    # an ambiguous switch must not be ignored: poses while it was released would be used
    problems = list(chain.from_iterable(each.problems for each in fitting))
    if problems:
        raise InputError(problems)
    if not fitting:
        return None, ()
    chosen, _ = best_match(fitting, DEAD_MAN_SWITCH)
    others = [each.stream() for each in fitting if each.table is not chosen.table]
    return chosen, tuple(f"{stream.channels[0].column} of {stream.table.name}" for stream in others)


def _match_switch(table: Table, mapping: Mapping) -> TableMatch:
    matcher, mapped_column = ColumnMatcher(table, mapping), mapping.dead_man
    column = None if mapped_column is None else Column(column=mapped_column.column)
    score = _bool_score if _is_switch(table) else dead_man_score
    switch = matcher.match("dead man", score, "control", ("dead_man",), column)
    stated = mapped_column.time if mapped_column else None
    if stated is None:  # in a table with several clocks the switch is on that which the mapping file names for others
        named = (mapping.commands.time, mapping.poses.time)
        stated = next((time for time in named if time is not None and time.column in table.columns), None)
    return TableMatch(table, matcher.clock(COMMAND, stated, "dead_man"), (switch,))


def _is_switch(table: Table) -> bool:
    return bool(table.topic) and dead_man_score(table.topic) is not None and set(table.columns) == {LOG_TIME, "data"}


def _bool_score(name: str) -> int | None:
    return 100 if name == "data" else None
