"""Choose tables and columns for commands, poses and dead man: what the mapping file says, and guesses for the rest."""

from __future__ import annotations

from collections.abc import Sequence

from kraft.errors import Diagnostic, InputError
from kraft.logs.attempts import Attempt, best
from kraft.logs.choice import Channel, Choice, Stream
from kraft.logs.columns import (
    COMMAND,
    POSE,
    axis_score,
    control_score,
    dead_man_score,
    quaternion_score,
    time_score,
    yaw_score,
)
from kraft.logs.mapping import Column, Mapping
from kraft.logs.names import parse
from kraft.logs.pick import Picked, Picker
from kraft.logs.table import Table
from kraft.suggest import choose as suggest


def choose(tables: Sequence[Table], controls: Sequence[str], mapping: Mapping) -> Choice:
    """Choose what a log is read from.

    Raises:
        InputError: with every role for which nothing or too much fits.
    """
    problems: list[Diagnostic] = []
    commands: tuple[Stream, ...] = ()
    unused: tuple[str, ...] = ()
    try:
        commands, unused = _commands(tables, controls, mapping)
    except InputError as error:
        problems += error.diagnostics
    try:
        poses, others = _poses(tables, mapping)
        dead_man = _dead_man(tables, mapping)
    except InputError as error:
        raise InputError([*problems, *error.diagnostics]) from error
    if problems:
        raise InputError(problems)
    return Choice(commands, poses, dead_man, tuple(dict.fromkeys(unused + others)))


def offers(table: Table, controls: Sequence[str], mapping: Mapping) -> tuple[bool, bool]:
    """Whether a table has all of the commands, and whether it has poses; clocks apart."""
    commands = _command_attempt(table, controls, mapping).found
    poses = _pose_attempt(table, mapping).found
    names = (None, table.name, table.file)
    return (
        mapping.commands.table in names and all(picked.channel for picked in commands),
        mapping.poses.table in names and all(picked.channel for picked in poses),
    )


def _named(tables: Sequence[Table], name: str | None, mapping: Mapping, *path: str) -> list[Table]:
    """Tables of this name, all if there is none."""
    if name is None:
        return list(tables)
    found = [table for table in tables if name in (table.name, table.topic, table.file)]
    if not found:
        files = ", ".join(dict.fromkeys(table.file for table in tables))
        expected = suggest(name, [table.name for table in tables])
        raise InputError([mapping.source.diagnostic(path, f"there is no {name!r} in {files}", expected)])
    return found


def _commands(
    tables: Sequence[Table], controls: Sequence[str], mapping: Mapping
) -> tuple[tuple[Stream, ...], tuple[str, ...]]:
    wishes = mapping.commands.controls
    _refuse_unknown(wishes, controls, mapping)
    apart = {name: wish.table for name, wish in wishes.items() if wish.table is not None}
    streams = []
    for name, at in apart.items():
        found = _named(tables, at, mapping, "commands", "controls", name, "table")
        streams.append(best([_command_attempt(table, [name], mapping) for table in found], "commands")[0])
    rest = [name for name in controls if name not in apart]
    unused: tuple[str, ...] = ()
    if rest:
        found = _named(tables, mapping.commands.table, mapping, "commands", "table")
        stream, unused = best([_command_attempt(table, rest, mapping) for table in found], "commands")
        streams.insert(0, stream)
    return tuple(streams), unused


def _refuse_unknown(wishes: dict[str, Column], controls: Sequence[str], mapping: Mapping) -> None:
    problems = [
        mapping.source.diagnostic(
            ("commands", "controls", name), "is no control of the vehicle", suggest(name, controls), at_key=True
        )
        for name in wishes
        if name not in controls
    ]
    if problems:
        raise InputError(problems)


def _command_attempt(table: Table, controls: Sequence[str], mapping: Mapping) -> Attempt:
    picker = Picker(table, mapping)
    time = _time(picker, COMMAND, mapping.commands.time, "commands")
    return Attempt(table, time, tuple(_control(picker, name) for name in controls))


def _control(picker: Picker, name: str) -> Picked:
    wish = picker.mapping.commands.controls.get(name)
    picked = picker.pick(
        name, lambda column: control_score(column, name), "control", ("commands", "controls", name), wish
    )
    if wish is None and picked.channel is not None and parse(picked.channel.column).words[-2:] == ("angular", "z"):
        note = "a turning rate by convention, taken as the steering command"
        return Picked(Channel(name, picked.channel.column, "1", note=note), picked.score)
    return picked


def _time(picker: Picker, family: set[str], wish: Column | None, *path: str) -> Picked:
    if picker.table.topic and wish is None:  # the reader of bags decided which clock to trust
        clock = "header.stamp" if "header.stamp" in picker.table.columns else "log_time"
        return Picked(picker.channel("time", clock, "time"))
    return picker.pick("time", lambda column: time_score(column, family), "time", (*path, "time"), wish)


def _poses(tables: Sequence[Table], mapping: Mapping) -> tuple[Stream, tuple[str, ...]]:
    found = _named(tables, mapping.poses.table, mapping, "poses", "table")
    return best([_pose_attempt(table, mapping) for table in found], "poses")


def _pose_attempt(table: Table, mapping: Mapping) -> Attempt:
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
    return Attempt(table, _time(picker, POSE, wishes.time, "poses"), (x, y, *turn))


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


def _dead_man(tables: Sequence[Table], mapping: Mapping) -> Stream | None:
    wish = mapping.dead_man
    found = _named(tables, wish.table if wish else None, mapping, "dead_man", "table")
    attempts = []
    for table in found:
        picker = Picker(table, mapping)
        column = None if wish is None else Column(column=wish.column)
        score = _bool_score if _is_switch(table) else dead_man_score
        switch = picker.pick("dead man", score, "control", ("dead_man",), column)
        attempts.append(Attempt(table, _time(picker, COMMAND, wish.time if wish else None, "dead_man"), (switch,)))
    if wish is None and all(attempt.problems for attempt in attempts):
        return None
    return best(attempts, "the dead-man switch")[0]


def _is_switch(table: Table) -> bool:
    return bool(table.topic) and dead_man_score(table.topic) is not None and set(table.columns) == {"log_time", "data"}


def _bool_score(name: str) -> int | None:
    return 100 if name == "data" else None
