"""The one place where an exception becomes text and an exit code."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator

import typer

from kraft.errors import Defect, InputError, KraftError, MissingError, NegativeResult
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal
from ompl_ext.cache_error import CacheError


def guarded(terminal: Terminal, command: Callable[[], ExitStatus]) -> ExitStatus:
    """Run a command; whatever it raises is explained on stderr."""
    try:
        status = _flushed(terminal, command)
    except KeyboardInterrupt:
        terminal.problem("interrupted")
        return ExitStatus.INTERRUPTED
    except BrokenPipeError:
        _abandon_stdout()
        return ExitStatus.DONE
    except typer.Exit as request:
        return ExitStatus(request.exit_code)
    except Exception as error:  # the boundary: everything has to end in an exit code
        status = explain(terminal, error)
        if terminal.traceback:
            terminal.problem("".join(traceback.format_exception(error)).rstrip())
    return status


def _flushed(terminal: Terminal, command: Callable[[], ExitStatus]) -> ExitStatus:
    """Run a command and have its output written, not only buffered.

    Raises:
        InputError: if stdout takes no more, because the disk is full.
    """
    try:
        try:
            return command()
        finally:
            terminal.out.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        if not _stdout_fails():
            raise
        _abandon_stdout()
        problem = f"cannot be written: {error.strerror}"
        raise InputError.of("stdout", problem, "expected a place with room for it") from error


def _stdout_fails() -> bool:
    try:
        sys.stdout.flush()  # what could not be written is still in its buffer
    except OSError:
        return True
    return False


def explain(terminal: Terminal, error: Exception) -> ExitStatus:
    """Say what went wrong and return the exit code for it."""
    if isinstance(error, InputError):
        for diagnostic in error.diagnostics:
            terminal.problem(str(diagnostic))
        return ExitStatus.INVALID
    if isinstance(error, typer.TyperException):
        return _explain_usage(terminal, error)
    if isinstance(error, CacheError):
        problem = f"{error.folder}: the kernel cache cannot be written: {error.reason}"
        terminal.problem(f"{problem}; expected a folder that can, KRAFT_CACHE_DIR says which")
        return ExitStatus.INVALID
    if isinstance(error, KraftError) and not isinstance(error, Defect):
        terminal.error(str(error))
        _explain_causes(terminal, error)
        if isinstance(error, NegativeResult):
            return ExitStatus.NEGATIVE
        return ExitStatus.MISSING if isinstance(error, MissingError) else ExitStatus.INTERNAL
    terminal.error(f"this is a defect in kraft: {type(error).__name__}: {error}")
    _explain_causes(terminal, error)
    if not terminal.traceback:
        terminal.problem("run it again with --traceback and report what it prints")
    return ExitStatus.INTERNAL


def _explain_usage(terminal: Terminal, error: typer.TyperException) -> ExitStatus:
    terminal.error(error.format_message())
    context = getattr(error, "ctx", None)
    terminal.problem(f"try '{context.command_path if context else 'kraft'} --help'")
    return ExitStatus.INVALID


def _explain_causes(terminal: Terminal, error: BaseException) -> None:
    for cause in _causes(error):
        terminal.problem(f"  caused by: {type(cause).__name__}: {cause}")


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    if cause is not None:
        yield cause
        yield from _causes(cause)


def _abandon_stdout() -> None:
    """Point stdout at nothing, so that Python's own flush at exit does not fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
