"""References to vehicles: a bundled name, the path of a YAML file, or code.

Code is ``module:attribute``, ``path/to/file.py:attribute``, or ``path/to/file.py`` if it defines one vehicle.
"""

from __future__ import annotations

import os
from pathlib import Path

from kraft.config import bundled
from kraft.config.user_code import is_attribute, is_code, split_file
from kraft.errors import Code
from kraft.files import path_from
from kraft.text import suggestion


class VehicleProblem(ValueError):  # noqa: N818 - callers that know the place convert it to an InputError
    """Reference to no vehicle."""

    def __init__(self, problem: str, expected: str, code: Code) -> None:
        super().__init__(problem, expected, code)
        self.problem = problem
        self.expected = expected
        self.code = code


def reference_of(vehicle: str | Path) -> str:
    """Reference of a text or a path; a path is never a bundled name, as for scenarios and methods.

    Raises:
        TypeError: if it is neither.
    """
    if not isinstance(vehicle, str | os.PathLike):
        raise TypeError(f"vehicle: expected a name, a path or code, not {type(vehicle).__name__}")
    text = os.fspath(vehicle)
    is_path = not isinstance(vehicle, str) and not is_code(text) and bundled.is_name(text)
    return os.path.join(os.curdir, text) if is_path else text


def resolve_vehicle(reference: str, folder: Path) -> str:
    """Check a reference and make its path, relative to ``folder``, absolute.

    Modules are not imported and files are not read.

    Raises:
        VehicleProblem: if there is no such name or file, or the reference has none of the forms.
    """
    if code := split_file(reference):
        file, attribute = code
        return _existing(path_from(folder, file), "a Python file") + (f":{attribute}" if attribute else "")
    if is_attribute(reference):
        return reference
    if ":" in reference and bundled.is_name(reference):
        raise VehicleProblem(f"{reference!r} is not a module and an attribute", "expected module:attribute", Code.VALUE)
    if bundled.is_name(reference):
        if reference not in bundled.names("vehicle"):
            if os.path.isfile(folder / reference):
                expected = "expected the path of a .yaml file or the name of a vehicle"
                raise VehicleProblem(f"{reference!r} is no vehicle file", expected, Code.MISMATCH)
            expected = suggestion(reference, bundled.names("vehicle"))
            raise VehicleProblem(f"there is no vehicle {reference!r}", expected, Code.NOT_FOUND)
        return reference
    return _existing(path_from(folder, reference), "a vehicle's YAML file")


def relative_vehicle(reference: str, folder: Path) -> str:
    """A resolved reference for a file in `folder`: a path relative to it, so that both can be moved together."""
    path, attribute = split_file(reference) or (reference, "")
    if not os.path.isabs(path):  # a name, or a module
        return reference
    return os.path.relpath(path, os.path.realpath(folder)) + (f":{attribute}" if attribute else "")


def _existing(path: Path, what: str) -> str:
    if not os.path.isfile(path):
        raise VehicleProblem(f"there is no file {path}", f"expected the path of {what}", Code.NOT_FOUND)
    return str(path.resolve())
