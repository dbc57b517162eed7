"""The logs of `kraft sysid`: read them, and report which column was taken for what and what was found."""

from __future__ import annotations

import re
from collections import Counter, abc
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Final

from kraft.errors import Code, Diagnostic, InputError, NegativeResult
from kraft.logs.discover import discover
from kraft.logs.log import Log, LogSet
from kraft.logs.mapping import Mapping, load_mapping
from kraft.logs.reader import MismatchError, read_logs
from kraft.sysid.command_units import SIDES
from kraft.sysid.data import screen_logs
from kraft.text import MessageSink
from kraft.vehicles import CAR_CONTROLS
from kraft_cli.work.recorded_controls import recorded_with_other_controls

Limits = abc.Mapping[str, tuple[float, float]]
"""Least and largest command by the name of the control."""
MANY: Final = 3
"""Number of logs with the same problem from which it is reported once."""
HARMLESS: Final = {
    "wrap": "yaw wraps; made continuous, nothing is left out",
    "dropout": "some poses are missing; nothing is left out",
    "repeated": "commands are recorded more often than they are sent; nothing is left out",
}
"""Kinds of findings that leave nothing out, with the message for several logs that have one."""
_NUMBER: Final = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number in a message, also of a log (`run_01`)."""


def read_sysid_logs(
    paths: Sequence[Path],
    mapping_file: Path | None,
    limits: Limits,
    info: MessageSink,
    warn: MessageSink,
    detail: MessageSink,
    *,
    any_command_unit: bool = False,
) -> LogSet:
    """Read every log; report which column was taken for what and what was found in each log.

    Args:
        paths: files and folders with logs.
        mapping_file: mapping file; None to guess every column.
        limits: least and largest command of each of the vehicle's controls.
        info: receives the column assignments and the findings.
        warn: receives problems of logs that are left out.
        detail: receives the place of each finding that `info` receives as a sum.
        any_command_unit: whether commands may be in any unit.

    Raises:
        InputError: if there are no logs, or mapping file or controls fit none of them.
        NegativeResult: if there are logs, and none of them can be used.
    """
    mapping, controls = Mapping() if mapping_file is None else load_mapping(mapping_file), tuple(limits)
    try:
        found = read_logs(paths, controls, mapping, any_command_unit=any_command_unit, limits=limits)
    except MismatchError:
        raise
    except InputError as error:
        candidates, _ = discover(paths, controls, mapping)
        if not candidates:
            raise
        if mapping_file is None and (other := recorded_with_other_controls(candidates, controls)):
            raise InputError([other]) from None
        _report_left_out(error.diagnostics, "", warn, detail)
        if any_command_unit and all(each.code == Code.MISSING for each in error.diagnostics):
            warn(
                "without --model, logs are those of a car (throttle, steering) or of a robot with two driven sides "
                "(left, right); for a vehicle with other controls, name its model with --model FILE.py:NAME"
            )
        raise _none_usable(len(candidates), error.diagnostics) from None
    long = screen_logs(found.logs)
    _report_logs(long.logs, info, detail)
    for shortened in long.shortened:
        info(shortened)
    _report_left_out((*found.problems, *long.problems), "left out: ", warn, detail)
    if not long.logs:
        raise _none_usable(len(discover(paths, controls, mapping)[0]), (*found.problems, *long.problems))
    return LogSet(long.logs, (*found.problems, *long.problems))


def has_two_sides(paths: Sequence[Path], mapping_file: Path | None) -> bool:
    """Whether the first log that can be read has the commands of a robot with two driven sides, and not of a car.

    Where none can be read, as without motion, the columns of the logs and the headings of the files tell.

    Raises:
        InputError: if the mapping file cannot be read.
    """
    mapping = Mapping() if mapping_file is None else load_mapping(mapping_file)
    candidates = discover(paths, SIDES, mapping)[0]
    for candidate in candidates:
        if _is_log_of(candidate.place, CAR_CONTROLS, mapping):
            return False
        if _is_log_of(candidate.place, SIDES, mapping):
            return True
    if any(_has_columns(c.place, SIDES, mapping) > _has_columns(c.place, CAR_CONTROLS, mapping) for c in candidates):
        return True
    return _are_pairs(paths, SIDES, mapping) and not _are_pairs(paths, CAR_CONTROLS, mapping)


def _are_pairs(paths: Sequence[Path], controls: Sequence[str], mapping: Mapping) -> bool:
    """Whether there are files with these commands and files with poses by their headings, though names may not pair."""
    candidates, problems = discover(paths, controls, mapping)
    return any(len(each.files) > 1 for each in candidates) or any(each.code == Code.MISSING for each in problems)


def _is_log_of(place: Path, controls: Sequence[str], mapping: Mapping) -> bool:
    """Whether a log has these commands."""
    try:
        read_logs([place], controls, mapping, any_command_unit=True)
    except InputError:  # what is wrong is reported when all logs are read
        return False
    return True


def _has_columns(place: Path, controls: Sequence[str], mapping: Mapping) -> bool:
    """Whether a log has columns for these commands, though it may not be usable for another reason."""
    try:
        read_logs([place], controls, mapping, any_command_unit=True)
    except InputError as error:
        return all(each.code == Code.DATA for each in error.diagnostics)
    return True


def _none_usable(count: int, problems: Sequence[Diagnostic]) -> NegativeResult:
    reason = "the only log cannot be used" if count == 1 else f"none of the {count} logs can be used"
    return NegativeResult(reason, problems)


def report_problems(error: InputError, warn: MessageSink) -> None:
    """Report every problem of an error."""
    for diagnostic in error.diagnostics:
        warn(str(diagnostic))


def _report_left_out(problems: Sequence[Diagnostic], begin: str, warn: MessageSink, detail: MessageSink) -> None:
    """Report the problems of logs, those that many have once: `detail` receives the others."""
    alike: dict[Hashable, list[Diagnostic]] = {}
    for problem in problems:
        alike.setdefault(_kind(problem), []).append(problem)
    for first, *others in alike.values():
        if len(others) + 1 < MANY:
            for problem in (first, *others):
                warn(f"{begin}{problem}")
            continue
        same = "the same" if all(each.problem == first.problem for each in others) else "the same with other numbers"
        warn(f"{begin}{first}; {same} in {len(others)} other logs (-v lists them)")
        for problem in others:
            detail(f"{begin}{problem}")


def _kind(problem: Diagnostic) -> Hashable:
    """What problems of several logs share: their words, or the place in the mapping file and what is expected there.

    Numbers do not count: each log has its own speeds, times and line.
    """
    at_a_key = problem.line is not None and problem.path
    what = problem.place if at_a_key else _NUMBER.sub("#", problem.problem)
    return problem.path, problem.code, _NUMBER.sub("#", problem.expected), what


def _report_logs(logs: Sequence[Log], info: MessageSink, detail: MessageSink) -> None:
    """Report the column assignments, once for logs that share them, and the findings; harmless ones as a sum."""
    kinds: dict[str, list[Log]] = {}
    for log in logs:
        kinds.setdefault(log.columns, []).append(log)
    for first, *others in kinds.values():
        info(f"{first.name}{f' and {len(others)} more' if others else ''}: {first.guess}")
        for log in others:
            if log.guess != first.guess:  # other names of files
                detail(f"{log.name}: {log.guess}")
    found = [(log.name, finding) for log in logs for finding in log.findings]
    often = Counter(finding.kind for _, finding in found)
    for kind, what in HARMLESS.items():
        if often[kind] > 1:
            info(f"{often[kind]} logs: {what} (-v lists them)")
    for name, finding in found:
        sink = detail if finding.kind in HARMLESS and often[finding.kind] > 1 else info
        sink(f"{name}: {finding}")
