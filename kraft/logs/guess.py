"""Choose tables and columns for commands, poses and dead man: what the mapping file says, and guesses for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final, TypeVar

from kraft.errors import Diagnostic, InputError
from kraft.logs.choice import Channel, Choice, Stream
from kraft.logs.mapping import Column, Mapping
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
from kraft.logs.pick import HOW, Picked, Picker, missing
from kraft.logs.table import LOG_TIME, Table
from kraft.text import suggestion

Found = TypeVar("Found")
_TOPIC_HINTS: Final = {
    **dict.fromkeys(("mocap", "vicon", "vrpn", "optitrack", "qualisys", "aruco", "apriltag", "marker", "camera"), 10),
    **dict.fromkeys(("inferred", "amcl", "slam", "localization"), 5),
    **dict.fromkeys(("odom", "odometry"), -5),  # often integrated from the commands
    **dict.fromkeys(("goal", "initialpose", "target", "waypoint", "goals", "clicked"), -60),
    **dict.fromkeys(("output", "out", "muxed"), 3),  # what the vehicle was sent, rather than what someone asked for
    **dict.fromkeys(("teleop", "safety", "nav", "navigation", "input", "joy", "raw"), -3),
}
_WHAT = "the dead-man switch"


def choose(tables: Sequence[Table], controls: Sequence[str], mapping: Mapping) -> Choice:
    """Choose what a log is read from.

    Raises:
        InputError: with every role for which nothing or too much fits.
    """
    problems: list[Diagnostic] = []
    commands = _or_problems(lambda: guess_commands(tables, controls, mapping), problems)
    poses = _or_problems(lambda: guess_poses(tables, mapping), problems)
    switch = _or_problems(lambda: guess_switch(tables, mapping), problems)
    if commands is None or poses is None or switch is None:
        raise InputError(problems)
    unused = (*commands[1], *poses[1], *switch[1])
    return Choice(commands[0], poses[0], switch[0], tuple(dict.fromkeys(unused)))


def offers(table: Table, controls: Sequence[str], mapping: Mapping) -> tuple[bool, bool]:
    """Whether a table has all of the commands, and whether it has poses; clocks apart."""
    commands = command_attempt(table, controls, mapping).found
    poses = pose_attempt(table, mapping).found
    names = (None, table.name, table.file)
    return (
        mapping.commands.table in names and all(picked.channel for picked in commands),
        mapping.poses.table in names and all(picked.channel for picked in poses),
    )


def _or_problems(guess: Callable[[], Found], problems: list[Diagnostic]) -> Found | None:
    """What is guessed; if that fails, None, and ``problems`` has why: those of all guesses are said together."""
    try:
        return guess()
    except InputError as error:
        problems += error.diagnostics
        return None


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


def guess_commands(
    tables: Sequence[Table], controls: Sequence[str], mapping: Mapping
) -> tuple[tuple[Stream, ...], tuple[str, ...]]:
    """Streams that together have every control once, and the names of other tables that fit.

    Raises:
        InputError: if nothing or too much fits, or the mapping file names what is not there.
    """
    if unknown := unknown_controls(controls, mapping):
        raise InputError(unknown)
    apart = {name: wish.table for name, wish in mapping.commands.controls.items() if wish.table is not None}
    streams = []
    for name, at in apart.items():
        found = named(tables, at, mapping, "commands", "controls", name, "table")
        streams.append(best([command_attempt(table, [name], mapping) for table in found], "commands")[0])
    rest = [name for name in controls if name not in apart]
    unused: tuple[str, ...] = ()
    if rest:
        found = named(tables, mapping.commands.table, mapping, "commands", "table")
        stream, unused = best([command_attempt(table, rest, mapping) for table in found], "commands")
        streams.insert(0, stream)
    return tuple(streams), unused


def command_attempt(table: Table, controls: Sequence[str], mapping: Mapping) -> Attempt:
    """Read a table as commands of these controls."""
    picker = Picker(table, mapping)
    time = picker.clock(COMMAND, mapping.commands.time, "commands")
    return Attempt(table, time, tuple(_control(picker, name) for name in controls))


def unknown_controls(controls: Sequence[str], mapping: Mapping) -> list[Diagnostic]:
    """Controls that the mapping file has columns for, and the vehicle has not."""
    return [
        mapping.source.diagnostic(
            ("commands", "controls", name), "is no control of the vehicle", suggestion(name, controls), at_key=True
        )
        for name in mapping.commands.controls
        if name not in controls
    ]


def _control(picker: Picker, name: str) -> Picked:
    wish = picker.mapping.commands.controls.get(name)
    picked = picker.pick(
        name, lambda column: control_score(column, name), "control", ("commands", "controls", name), wish
    )
    if wish is None and picked.channel is not None and parse(picked.channel.column).words[-2:] == ("angular", "z"):
        note = "a turning rate by convention, taken as the steering command"
        return Picked(Channel(name, picked.channel.column, "1", note=note), picked.score)
    return picked


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


def guess_switch(tables: Sequence[Table], mapping: Mapping) -> tuple[Stream | None, tuple[str, ...]]:
    """Stream of the switch, None if no column looks like one, and the columns of other tables that fit.

    Raises:
        InputError: if too much fits, or the mapping file names what is not there.
    """
    wish = mapping.dead_man
    found = named(tables, wish.table if wish else None, mapping, "dead_man", "table")
    attempts = [_attempt(table, mapping) for table in found]
    if wish is not None:
        return best(attempts, _WHAT)
    fitting = [attempt for attempt in attempts if not attempt.found[0].missing]
    # a switch that is doubtful must not be ignored: what was driven while it was released would be believed
    problems = list(chain.from_iterable(attempt.problems for attempt in fitting))
    if problems:
        raise InputError(problems)
    if not fitting:
        return None, ()
    chosen, _ = best(fitting, _WHAT)
    others = [attempt.stream() for attempt in fitting if attempt.table is not chosen.table]
    return chosen, tuple(f"{stream.channels[0].column} of {stream.table.name}" for stream in others)


def _attempt(table: Table, mapping: Mapping) -> Attempt:
    picker, wish = Picker(table, mapping), mapping.dead_man
    column = None if wish is None else Column(column=wish.column)
    score = _bool_score if _is_switch(table) else dead_man_score
    switch = picker.pick("dead man", score, "control", ("dead_man",), column)
    return Attempt(table, picker.clock(COMMAND, wish.time if wish else None, "dead_man"), (switch,))


def _is_switch(table: Table) -> bool:
    return bool(table.topic) and dead_man_score(table.topic) is not None and set(table.columns) == {LOG_TIME, "data"}


def _bool_score(name: str) -> int | None:
    return 100 if name == "data" else None
