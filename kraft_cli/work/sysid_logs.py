"""The logs of `kraft sysid`: read them, and report which column was taken for what and what was found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from kraft.errors import InputError, NegativeResult
from kraft.logs.discover import discover
from kraft.logs.log import Log, LogSet
from kraft.logs.mapping import Mapping, load_mapping
from kraft.logs.reader import UnfitError, read_logs
from kraft.sysid.data import screened

Say = Callable[[str], None]

HARMLESS: Final = {
    "wrap": "yaw wraps; made continuous, nothing is left out",
    "dropout": "poses are missing here and there; nothing is left out",
}
"""Findings of logs that cost nothing, by kind, and what is said of several logs with one."""


def read(
    paths: Sequence[Path], mapping_file: Path | None, controls: Sequence[str], say: Say, warn: Say, detail: Say
) -> LogSet:
    """Read every log, and say what it was taken for and what was found in it.

    Args:
        paths: files and folders with logs.
        mapping_file: which column is what, if that is said.
        controls: of the vehicle.
        say: is told what was taken for what and what was found.
        warn: is told what is wrong with logs that are left out.
        detail: is told where that was found of which `say` gets a sum.

    Raises:
        InputError: if there are no logs, or mapping file or controls fit none of them.
        NegativeResult: if there are logs, and none of them can be used.
    """
    mapping = Mapping() if mapping_file is None else load_mapping(mapping_file)
    try:
        found = read_logs(paths, controls, mapping)
    except UnfitError:
        raise
    except InputError as error:
        candidates, _ = discover(paths, controls, mapping)
        if not candidates:
            raise
        explain(error, warn)
        raise _none_usable(len(candidates)) from None
    long = screened(found.logs)
    _tell(long.logs, say, detail)
    for shortened in long.shortened:
        say(shortened)
    for problem in (*found.problems, *long.problems):
        warn(f"left out: {problem}")
    if not long.logs:
        raise _none_usable(len(discover(paths, controls, mapping)[0]))
    return LogSet(long.logs, (*found.problems, *long.problems))


def _none_usable(count: int) -> NegativeResult:
    return NegativeResult("the only log cannot be used" if count == 1 else f"none of the {count} logs can be used")


def explain(error: InputError, warn: Say) -> None:
    """Tell every problem."""
    for diagnostic in error.diagnostics:
        warn(str(diagnostic))


def _tell(logs: Sequence[Log], say: Say, detail: Say) -> None:
    """Say what was taken for what, once for logs of one kind, and what was found; what is harmless is summed up."""
    kinds: dict[str, list[str]] = {}
    for log in logs:
        kinds.setdefault(log.guess, []).append(log.name)
    for guess, names in kinds.items():
        whose = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        say(f"{whose}: {guess}")
    found = [(log.name, finding) for log in logs for finding in log.findings]
    often = Counter(finding.kind for _, finding in found)
    for kind, what in HARMLESS.items():
        if often[kind] > 1:
            say(f"{often[kind]} logs: {what} (-v tells where)")
    for name, finding in found:
        tell = detail if finding.kind in HARMLESS and often[finding.kind] > 1 else say
        tell(f"{name}: {finding}")
