"""Exceptions of kraft, and the diagnostics that they carry.

    KraftError
    ├── InputError             invalid input; carries every problem found, each with its place
    ├── MissingError           the installation lacks something
    │   ├── MissingDependency  a package
    │   └── MissingAsset       a file that kraft itself ships or makes
    ├── NegativeResult         the computation succeeded with a negative result (no plan, not identifiable)
    │   └── Unreachable        no path leads to the goal; carries the places of the goals
    └── Defect                 an error in kraft itself, never in its input

A name or file that the user gave and that does not exist is an InputError.  The command line assigns exit codes.
"""

# ruff: noqa: N818 - a name without "Error" where nothing is erroneous

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from numbers import Integral
from typing import Self, TypeVar

Result = TypeVar("Result")


class Code(StrEnum):
    """Kind of a problem.  Programs and tests decide by the code, never by the text."""

    SYNTAX = "syntax"
    """the file does not have the format of its kind"""
    TYPE = "type"
    """a value of another type"""
    VALUE = "value"
    """a value of the right type that is not allowed"""
    UNKNOWN = "unknown"
    """a key, parameter, column or name that does not exist"""
    MISSING = "missing"
    """something required is not given"""
    DUPLICATE = "duplicate"
    """something is given twice"""
    CONFLICT = "conflict"
    """values that are allowed alone, but not together"""
    MISMATCH = "mismatch"
    """a file or a result that does not fit what it is used for"""
    NOT_FOUND = "not-found"
    """there is no such file, folder, module or bundled name"""
    UNREADABLE = "unreadable"
    """it exists and cannot be read"""
    UNWRITABLE = "unwritable"
    """it cannot be written"""
    EXISTS = "exists"
    """it exists and must not be replaced"""
    GEOMETRY = "geometry"
    """poses or shapes that are invalid or inconsistent in the scene"""
    CODE = "code"
    """a user's Python code fails or returns a wrong value"""
    DATA = "data"
    """logs that cannot be used, or contain too little information"""


@dataclass(frozen=True)
class Diagnostic:
    """Problem at one place; prints as ``FILE:LINE:COLUMN: path.to.key: problem; expected``.

    Attributes:
        file: file, name or argument that is wrong.
        problem: what is wrong.
        expected: the value to give instead.
        line, column: counted from 1; both None for the file as a whole, the column alone for a whole row.
        path: key that is wrong; empty if the problem is not at a key.
        code: kind of the problem.
        argument: whether `file` is the name of a function's argument; the command line prints the option instead.
    """

    file: str
    problem: str
    expected: str
    line: int | None = None
    column: int | None = None
    path: str = ""
    code: Code = Code.VALUE
    argument: bool = False

    @property
    def place(self) -> str:
        """``FILE:LINE:COLUMN``, ``FILE:LINE`` or the file alone."""
        return ":".join(str(part) for part in (self.file, self.line, self.column) if part is not None)

    def __str__(self) -> str:
        key = f"{self.path}: " if self.path else ""
        return f"{self.place}: {key}{self.problem}; {self.expected}"


class KraftError(Exception):
    """Base class of all exceptions that kraft raises."""


class InputError(KraftError):
    """Invalid input. ``diagnostics`` holds every problem, in the order of the file."""

    diagnostics: tuple[Diagnostic, ...]

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        found = dict.fromkeys(diagnostics)  # two checks may report the same problem
        self.diagnostics = tuple(sorted(found, key=lambda d: (d.file, d.line or 0, d.column or 0)))
        super().__init__(self.diagnostics)

    @classmethod
    def of(cls, subject: str, problem: str, expected: str, code: Code = Code.VALUE) -> Self:
        """Error with a single problem of ``subject``, a file or a name."""
        return cls([Diagnostic(subject, problem, expected, code=code)])

    @classmethod
    def of_argument(cls, name: str, problem: str, expected: str, code: Code = Code.VALUE) -> Self:
        """Error with a single problem of the argument ``name`` of a function."""
        return cls([Diagnostic(name, problem, expected, code=code, argument=True)])

    def __str__(self) -> str:
        return "\n".join(str(d) for d in self.diagnostics)


class UserCodeError(InputError):
    """The user's own code fails while it runs: of many trials, this may concern one."""


class Problems:
    """Collects the problems of several steps, so that they are reported together; ``found`` holds them."""

    def __init__(self) -> None:
        """Start without problems."""
        self.found: list[Diagnostic] = []

    def of(self, step: Callable[[], Result]) -> Result | None:
        """Run a step and return its result, or keep its problems and return None."""
        try:
            return step()
        except InputError as error:
            self.found += error.diagnostics
            return None

    def check(self) -> None:
        """Raise an `InputError` with the problems found, if there are any."""
        if self.found:
            raise InputError(self.found)


def out_of_range(name: str, value: object, least: int, most: int | None = None) -> list[Diagnostic]:
    """Problem of the argument ``name`` if its value is no whole number from ``least`` to ``most``; at most one."""
    expected = f"of at least {least}" if most is None else f"from {least} to {most:,}"
    if not isinstance(value, Integral):
        problem, kind = f"is {value!r}", f"expected a whole number {expected}"
        return [Diagnostic(name, problem, kind, code=Code.TYPE, argument=True)]
    number = int(value)
    if number >= least and (most is None or number <= most):
        return []
    return [Diagnostic(name, f"is {number:.12g}", f"expected a number {expected}", argument=True)]


class MissingError(KraftError):
    """The installation lacks something."""


class MissingDependency(MissingError):
    """A Python package or system library is missing or does not load."""


class MissingAsset(MissingError):
    """A file that kraft ships or makes is missing."""


class NegativeResult(KraftError):
    """The computation succeeded with a negative result.

    Attributes:
        reason: why, in one sentence.
        diagnostics: problems that led to it, with their places.
    """

    def __init__(self, reason: str, diagnostics: Iterable[Diagnostic] = ()) -> None:
        super().__init__(reason)
        self.reason = reason
        self.diagnostics = tuple(dict.fromkeys(diagnostics))


class Unreachable(NegativeResult):
    """No path leads to a goal. ``diagnostics`` names the goals and where they are written."""

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        found = tuple(diagnostics)
        super().__init__(found[0].problem, found)

    def __str__(self) -> str:
        return "\n".join(str(d) for d in self.diagnostics)


class Defect(KraftError):
    """Error in kraft itself."""
