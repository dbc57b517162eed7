"""What can go wrong, as types.

    KraftError
    ├── InputError             what was given is wrong; carries every problem found, each with its place
    ├── MissingError           something this installation should have is not there
    │   ├── MissingDependency  a package
    │   └── MissingAsset       a file that kraft itself ships or makes
    ├── NegativeResult         everything worked and the answer is no (no plan found, not identifiable)
    │   └── Unreachable        no path leads to the goal; carries the places of the goals
    └── Defect                 kraft broke a promise it makes; never the user's fault

A name or file that the user gave and that does not exist is an InputError. Exit codes belong to the
command line, not here.
"""

# ruff: noqa: N818 - the names say what happened

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Code(StrEnum):
    """What kind of problem a diagnostic reports.  Programs and tests decide by the code, never by the text."""

    SYNTAX = "syntax"
    """the file does not have the format that its kind has"""
    TYPE = "type"
    """a value of another type"""
    VALUE = "value"
    """a value of the right type that is not allowed"""
    UNKNOWN = "unknown"
    """a key, parameter, column or name that does not exist"""
    MISSING = "missing"
    """something that has to be given is not"""
    DUPLICATE = "duplicate"
    """something is given twice"""
    CONFLICT = "conflict"
    """things that are allowed, but not together"""
    MISMATCH = "mismatch"
    """a file or a result of something else than what it is used for"""
    NOT_FOUND = "not-found"
    """there is no such file, folder, module or bundled name"""
    UNREADABLE = "unreadable"
    """it is there and cannot be read"""
    UNWRITABLE = "unwritable"
    """nothing can be written there"""
    EXISTS = "exists"
    """something is there that must not be replaced"""
    GEOMETRY = "geometry"
    """poses, shapes or places that do not go together in the scene"""
    CODE = "code"
    """a user's Python code fails or returns something else than it should"""
    DATA = "data"
    """logs that cannot be used, or show too little"""


@dataclass(frozen=True)
class Diagnostic:
    """One problem in one place; prints as ``FILE:LINE:COLUMN: path.to.key: problem; expected``.

    Attributes:
        file: the file, name or argument that is wrong.
        problem: what is wrong with it.
        expected: what to give instead.
        line, column: from 1; both None when the problem is the file itself, the column alone when it is a whole row.
        path: the key that is wrong; empty when the problem is not at a key.
        code: what kind of problem it is.
        argument: whether `file` is the name of a function's argument; the command line prints the option for it.
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
    """Root of everything kraft raises on purpose."""


class InputError(KraftError):
    """What was given is wrong. ``diagnostics`` holds every problem, in the order of the file."""

    diagnostics: tuple[Diagnostic, ...]

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        found = dict.fromkeys(diagnostics)  # the same problem seen through two checks is said once
        self.diagnostics = tuple(sorted(found, key=lambda d: (d.file, d.line or 0, d.column or 0)))
        super().__init__(self.diagnostics)

    @classmethod
    def of(cls, subject: str, problem: str, expected: str, code: Code = Code.VALUE) -> InputError:
        """Make the error for a single problem of ``subject`` (a file or a name) as a whole."""
        return cls([Diagnostic(subject, problem, expected, code=code)])

    @classmethod
    def of_argument(cls, name: str, problem: str, expected: str, code: Code = Code.VALUE) -> InputError:
        """Make the error for a single problem of the argument ``name`` of a function."""
        return cls([Diagnostic(name, problem, expected, code=code, argument=True)])

    def __str__(self) -> str:
        return "\n".join(str(d) for d in self.diagnostics)


class MissingError(KraftError):
    """Something this installation should have is not there."""


class MissingDependency(MissingError):
    """A Python package or system library is missing or does not load."""


class MissingAsset(MissingError):
    """A file that kraft ships or makes is missing."""


class NegativeResult(KraftError):
    """Everything worked and the answer is no."""


class Unreachable(NegativeResult):
    """No path leads to a goal, whatever is tried. ``diagnostics`` says which goals, and where they were written."""

    diagnostics: tuple[Diagnostic, ...]

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = tuple(dict.fromkeys(diagnostics))
        super().__init__(self.diagnostics)

    def __str__(self) -> str:
        return "\n".join(str(d) for d in self.diagnostics)


class Defect(KraftError):
    """kraft broke a promise it makes."""
