"""Python code of the user: references to it, ``module:attribute`` or ``path/to/file.py:attribute``, and its import."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import re
import sys
import sysconfig
import traceback
from pathlib import Path
from types import ModuleType
from typing import Final

import ompl_ext
from kraft.errors import Code, Diagnostic, InputError, UserCodeError

_ATTRIBUTE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*\Z")
_FILE = re.compile(r"(?P<file>.+\.py)(:(?P<attribute>[A-Za-z_]\w*))?\Z", re.DOTALL)
_OURS: Final = Path(__file__).parents[1], Path(ompl_ext.__file__).parent
_INSTALLED: Final = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))
_imported: Final[set[Path]] = set()
"""Files of the user's modules that this process has imported by a reference."""


def is_attribute(text: str) -> bool:
    """Whether ``text`` has the form ``module:attribute``, as in ``my_robots.car:CAR``."""
    return _ATTRIBUTE.match(text) is not None


def split_file(text: str) -> tuple[str, str] | None:
    """File and attribute of ``path/to/file.py:attribute`` (the attribute may be left out), else None."""
    found = _FILE.match(text)
    return (found["file"], found["attribute"] or "") if found else None


def is_code(text: str) -> bool:
    """Whether ``text`` has the form of a reference to code."""
    return is_attribute(text) or split_file(text) is not None


def imported(reference: str, subject: str, expected: str) -> tuple[ModuleType, str]:
    """Module of a reference to code, and the attribute, empty if the reference names none.

    A relative path is relative to the working directory.  Errors name `subject`, and what is `expected` of the code.

    Raises:
        InputError: if the module cannot be imported.
    """
    code = split_file(reference)
    if code is None:
        name, _, attribute = reference.partition(":")
        module = _import(name, subject, expected)
    else:
        module, attribute = _import_file(Path(code[0]), subject, expected), code[1]
    if module.__file__ and not _is_within(module.__file__, _OURS):
        _imported.add(Path(module.__file__).resolve())
    return module, attribute


def _import(name: str, subject: str, expected: str) -> ModuleType:
    """Import a module by name, also one of the working directory, which is searched last.

    First, its files would take the place of installed packages, here and in all worker processes.
    """
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise import_error(error, subject, expected) from error


def _import_file(file: Path, subject: str, expected: str) -> ModuleType:
    """Execute a file once as a module, named after its path, because compiled code is cached by module name."""
    path = file.resolve()
    name = f"kraft_vehicle_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError.of(subject, f"there is no file {file}", "expected the path of a Python file", Code.NOT_FOUND)
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:  # so that it can import modules of its folder, as a script can
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        del sys.modules[name]
        raise import_error(error, subject, expected) from error
    except BaseException:  # of an interrupt, too, no part of the module is left
        del sys.modules[name]
        raise
    return module


def import_error(error: BaseException, subject: str, expected: str) -> InputError:
    """Error with an exception that the import of the user's code raised, and its line there."""
    return InputError.of(subject, f"does not import: {with_place(error)}", expected, Code.CODE)


def with_place(error: BaseException) -> str:
    """Type and text of an exception that the user's code raised, and its last line there."""
    place = line_of(error)
    return described(error) + ("" if place is None else f" at {place[0]}:{place[1]}")


def described(error: BaseException) -> str:
    """Type and text of an exception."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def line_of(error: BaseException) -> tuple[str, int] | None:
    """File and line in the user's code that an exception comes from: the last one that no installed package has.

    None if the traceback has only lines of kraft.
    """
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<")]
    theirs = [f for f in frames if "importlib" not in f.filename and not _is_within(f.filename, _OURS)]
    own = [frame for frame in theirs if not _is_within(frame.filename, _INSTALLED)] or theirs
    return (own[-1].filename, own[-1].lineno or 1) if own else None


def failure_in_code(error: BaseException) -> UserCodeError | None:
    """Error with the file and line in the user's code that an exception was raised in; None if it was raised elsewhere.

    The user's code is what `imported` has imported, and files beside it: compiled functions of a vehicle raise where
    no caller expects it.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if _is_own(Path(frame.filename).resolve())]
    if not own:
        return None
    expected = "expected code that returns numbers for every state and control"
    return UserCodeError([Diagnostic(own[-1].filename, described(error), expected, own[-1].lineno, code=Code.CODE)])


def _is_own(file: Path) -> bool:
    beside = {each.parent for each in _imported} - {*_INSTALLED, *_OURS}
    return file in _imported or file.parent in beside


def _is_within(file: str, folders: tuple[Path, ...]) -> bool:
    return any(Path(file).is_relative_to(folder) for folder in folders)


def place_of(module: ModuleType) -> str:
    """File of a module, or its name if it has none."""
    return str(module.__file__ or module.__name__)
