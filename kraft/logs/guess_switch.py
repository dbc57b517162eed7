"""Choose the table and the column of the dead-man switch; most logs have none."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

from kraft.errors import InputError
from kraft.logs.attempts import Attempt, best, named
from kraft.logs.choice import Stream
from kraft.logs.columns import COMMAND, dead_man_score
from kraft.logs.mapping import Column, Mapping
from kraft.logs.pick import Picker
from kraft.logs.table import LOG_TIME, Table

_WHAT = "the dead-man switch"


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
