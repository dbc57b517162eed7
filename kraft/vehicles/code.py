"""Import of vehicles from ``module:attribute`` or ``path/to/file.py:attribute``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

import ompl_ext
from kraft.errors import Code, InputError
from kraft.text import suggestion
from kraft.vehicles.reference import split_file
from ompl_ext.vehicle import Vehicle

_PLANNER = Path(ompl_ext.__file__).parent


def vehicle_of(reference: str, subject: str = "") -> Vehicle:
    """Vehicle of a reference to code; a relative path is relative to the working directory.

    Errors name `subject`, by default the reference.

    Raises:
        InputError: if the module cannot be imported, or the attribute is missing or not a vehicle.
    """
    subject = subject or reference
    code = split_file(reference)
    if code is None:
        name, _, attribute = reference.partition(":")
        return _attribute(_import(name, subject), attribute, subject)
    file, attribute = code
    module = _import_file(Path(file), subject)
    return _attribute(module, attribute, subject) if attribute else _only(module, subject)


def _import(name: str, subject: str) -> ModuleType:
    """Import a module by name; the working directory is searched first, as `python -m` does."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise _import_error(error, subject) from error


def _import_file(file: Path, subject: str) -> ModuleType:
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
        raise _import_error(error, subject) from error
    return module


def _import_error(error: BaseException, subject: str) -> InputError:
    """Error with the exception and its line in the user's code."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__]
    files = [f for f in frames if not f.filename.startswith("<") and "importlib" not in f.filename]
    theirs = [f for f in files if not Path(f.filename).is_relative_to(_PLANNER)]
    place = f" at {theirs[-1].filename}:{theirs[-1].lineno}" if theirs else ""
    problem = f"does not import: {type(error).__name__}: {error}{place}"
    return InputError.of(subject, problem, "expected code that defines a Vehicle", Code.CODE)


def _attribute(module: ModuleType, attribute: str, subject: str) -> Vehicle:
    vehicles = _vehicles(module)
    if not hasattr(module, attribute):
        expected = suggestion(attribute, vehicles, none="expected the name of a Vehicle, and it defines none")
        raise InputError.of(subject, f"there is no {attribute} in {_place(module)}", expected, Code.NOT_FOUND)
    value = getattr(module, attribute)
    if not isinstance(value, Vehicle):
        expected = suggestion(attribute, vehicles, none="expected an ompl_ext.vehicle.Vehicle")
        problem = f"{attribute} is of type {type(value).__name__}, not a Vehicle"
        raise InputError.of(subject, problem, expected, Code.TYPE)
    return value


def _only(module: ModuleType, subject: str) -> Vehicle:
    vehicles = _vehicles(module)
    if len(vehicles) != 1:
        found = f"defines {len(vehicles)} vehicles" if vehicles else "defines no Vehicle"
        expected = f"expected one of {', '.join(f'{subject}:{name}' for name in vehicles)}"
        if not vehicles:
            expected = "expected a module-level ompl_ext.vehicle.Vehicle"
        raise InputError.of(subject, found, expected, Code.CODE)
    return next(iter(vehicles.values()))


def _vehicles(module: ModuleType) -> dict[str, Vehicle]:
    return {name: value for name, value in vars(module).items() if isinstance(value, Vehicle)}


def _place(module: ModuleType) -> str:
    return str(module.__file__ or module.__name__)
