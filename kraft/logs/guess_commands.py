"""Choose the table and the columns of the commands; controls may be in tables of their own."""

from __future__ import annotations

from collections.abc import Sequence

from kraft.errors import Diagnostic, InputError
from kraft.logs.attempts import Attempt, best, named
from kraft.logs.choice import Channel, Stream
from kraft.logs.columns import COMMAND, control_score
from kraft.logs.mapping import Mapping
from kraft.logs.names import parse
from kraft.logs.pick import Picked, Picker
from kraft.logs.table import Table
from kraft.text import suggestion


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
