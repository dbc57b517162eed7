"""Choose tables and columns for commands, poses and dead man: what the mapping file says, and guesses for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from kraft.errors import Diagnostic, InputError
from kraft.logs.choice import Choice
from kraft.logs.guess_commands import command_attempt, guess_commands
from kraft.logs.guess_poses import guess_poses, pose_attempt
from kraft.logs.guess_switch import guess_switch
from kraft.logs.mapping import Mapping
from kraft.logs.table import Table

Found = TypeVar("Found")


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
