"""Error boundary: the one place that converts an exception to messages and an exit code."""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, Final

import typer

from kraft.config.user_code import failure_in_code
from kraft.errors import Code, Defect, Diagnostic, InputError, KraftError, MissingError, NegativeResult, Unreachable
from kraft.files import EXPECTED
from kraft_cli.exit_status import ExitStatus
from kraft_cli.signals import status_of, word_of
from kraft_cli.terminal import Terminal, diagnostic_json, discard
from ompl_ext.cache_error import CacheError

FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Error numbers of a write that fails because of the disk."""

NOUNS: Final = {"int_": "a whole number", "float_": "a number"}
"""What an option expects, by the beginning of the type of pydantic's error."""

ALIKE: Final = 0.65
"""Least similarity, without the hyphens, of an option of a command that is suggested: --metod is no --set."""

MISSPELT: Final = 0.75
"""Least similarity of a misspelt option: --vision is --version, and --json, an option of the commands, is not."""

POSITIONAL: Final = ("files", "logs", "results", "scenario", "scenarios", "sources")
"""Arguments that the commands take without an option."""


def guarded(terminal: Terminal, command: Callable[[], ExitStatus]) -> ExitStatus:
    """Run a command and report every exception on stderr."""
    try:
        status = _flushed(terminal, command)
    except KeyboardInterrupt as error:
        terminal.problem(word_of(error))
        return status_of(error)
    except BrokenPipeError:
        discard(sys.stdout)
        return ExitStatus.DONE
    except typer.Exit as request:
        return ExitStatus(request.exit_code)
    except SystemExit as request:
        return _requested(terminal, request)
    except Exception as error:  # every exception has to end in an exit code
        status = explain(terminal, error)
    return status


def _requested(terminal: Terminal, request: SystemExit) -> ExitStatus:
    """Exit code that typer's options for the completion, or its answer to fish, end with; any other is a defect."""
    code = 0 if request.code is None else request.code
    if code in list(ExitStatus):
        return ExitStatus(int(code))
    return explain(terminal, Defect(f"something has ended the command with {request.code!r}"))


def _flushed(terminal: Terminal, command: Callable[[], ExitStatus]) -> ExitStatus:
    """Run a command and flush its output.

    Raises:
        InputError: if stdout, or a file without a handler of its own, cannot be written because the disk is full.
    """
    try:
        status = command()
        terminal.out.flush()
    except OSError as error:
        if error.errno not in FULL:
            raise
        place = error.filename or ("stdout" if _stdout_fails() else "a file")
        problem = f"cannot be written: {error.strerror}"
        raise InputError.of(str(place), problem, EXPECTED, Code.UNWRITABLE) from error
    return status


def _stdout_fails() -> bool:
    """Whether stdout cannot be written, found with a new line, because a failed write may have emptied the buffer."""
    try:
        print(flush=True)
    except OSError:
        discard(sys.stdout)
        return True
    return False


def explain(terminal: Terminal, error: Exception) -> ExitStatus:
    """Report an exception, with ``--traceback`` also its traceback, and return its exit code."""
    status = _explained(terminal, error)
    if terminal.traceback:
        terminal.problem("".join(traceback.format_exception(error)).rstrip())
    return status


def _explained(terminal: Terminal, error: Exception) -> ExitStatus:
    if isinstance(error, InputError | Unreachable):
        for diagnostic in error.diagnostics:
            terminal.problem(str(_with_option(diagnostic)))
        return ExitStatus.INVALID if isinstance(error, InputError) else _negative(terminal, error)
    if isinstance(error, typer.TyperException):
        return _explain_usage(terminal, error)
    if isinstance(error, CacheError):
        terminal.problem(str(error))
        return ExitStatus.INVALID
    if isinstance(error, KraftError) and not isinstance(error, Defect):
        terminal.error(str(error))
        _explain_causes(terminal, error)
        if isinstance(error, NegativeResult):
            return _negative(terminal, error)
        return ExitStatus.MISSING if isinstance(error, MissingError) else ExitStatus.INTERNAL
    if (failure := failure_in_code(error)) is not None:
        return _explained(terminal, failure)
    terminal.error(f"this is a defect in kraft: {type(error).__name__}: {error}")
    _explain_causes(terminal, error)
    if not terminal.traceback:
        terminal.problem("run it again with --traceback and report what it prints")
    return ExitStatus.INTERNAL


def _negative(terminal: Terminal, error: NegativeResult) -> ExitStatus:
    """Print the JSON object of a result that is negative before there is anything else to print."""
    if terminal.json_schema:
        problems = [diagnostic_json(_with_option(diagnostic)) for diagnostic in error.diagnostics]
        terminal.json(terminal.json_schema, {"reason": error.reason, "problems": problems})
    return ExitStatus.NEGATIVE


def _with_option(diagnostic: Diagnostic) -> Diagnostic:
    """Same problem, reported at the option of the command instead of at the argument of the library."""
    if not diagnostic.argument or diagnostic.file in POSITIONAL:
        return diagnostic
    return replace(diagnostic, file=f"--{diagnostic.file.replace('_', '-')}", argument=False)


def _explain_usage(terminal: Terminal, error: typer.TyperException) -> ExitStatus:
    unread = _unread_value(error)
    if unread is None:
        terminal.error(_usage_message(error))
    else:
        terminal.problem(str(unread))
    context = getattr(error, "ctx", None)
    terminal.problem(f"try '{context.command_path if context else 'kraft'} --help'")
    return ExitStatus.INVALID


def _usage_message(error: typer.TyperException) -> str:
    """Message of an error of usage; where an option precedes the name of its command, it says so."""
    option, context = getattr(error, "option_name", None), getattr(error, "ctx", None)
    if option is None or context is None or not hasattr(error, "possibilities"):
        return error.format_message().replace(". Did you mean", "; did you mean")  # of commands, as of all else
    alike = " or ".join(map(repr, _alike(option, context)))
    message = f"No such option: {option}" + (f"; did you mean {alike}?" if alike else "")
    if context.parent is not None or _is_misspelt(option, context):
        return message
    if not any(_has(command, option) for command in getattr(context.command, "commands", {}).values()):
        return message
    return f"No such option before the command: {option}; expected it after, as in 'kraft COMMAND {option}'"


def _has(command: Any, option: str) -> bool:
    return any(option in parameter.opts for parameter in command.params)


def _alike(option: str, context: typer.Context) -> list[str]:
    """Options of a command that begin as a misspelt one; without any, those that resemble it in more than hyphens."""
    word = option.lstrip("-")
    known = {name.lstrip("-"): name for parameter in context.command.params for name in parameter.opts}
    longer = [name for each, name in known.items() if each.startswith(word)]
    return longer or [known[each] for each in get_close_matches(word, known, cutoff=ALIKE)]


def _is_misspelt(option: str, context: typer.Context) -> bool:
    """Whether an option is nearly one that kraft has before the name of a command."""
    known = [name for parameter in context.command.params for name in parameter.opts]
    return bool(get_close_matches(option, known, cutoff=MISSPELT))


def _unread_value(error: typer.TyperException) -> Diagnostic | None:
    """Problem of an option whose text is no number, of which pydantic knows the text; None for other errors."""
    from pydantic import ValidationError

    parameter = getattr(error, "param", None)
    if parameter is None or not isinstance(error.__cause__, ValidationError):
        return None
    detail = error.__cause__.errors()[0]
    expected = next((noun for kind, noun in NOUNS.items() if detail["type"].startswith(kind)), "another value")
    return Diagnostic(max(parameter.opts, key=len), f"is {detail['input']!r}", f"expected {expected}", code=Code.TYPE)


def _explain_causes(terminal: Terminal, error: BaseException) -> None:
    for cause in _causes(error):
        terminal.problem(f"  caused by: {type(cause).__name__}: {cause}")


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    if cause is not None:
        yield cause
        yield from _causes(cause)
