"""Import the Python object that ``module:attribute`` or ``path/to/file.py:attribute`` names."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from kraft.errors import InputError
from kraft.suggest import choose
from kraft.vehicle_reference import split_file
from ompl_ext.vehicle import Vehicle


def vehicle_of(reference: str) -> Vehicle:
    """The vehicle that a reference to code names; a relative path is relative to the working directory.

    Raises:
        InputError: if the module does not import, or what is named is not there or not a vehicle.
    """
    code = split_file(reference)
    if code is None:
        name, _, attribute = reference.partition(":")
        return _attribute(_import(reference, name), attribute, reference)
    file, attribute = code
    module = _import_file(reference, Path(file))
    return _attribute(module, attribute, reference) if attribute else _only(module, reference)


def _import(reference: str, name: str) -> ModuleType:
    """Import a module by name; the working directory is searched first, as `python -m` does."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        return importlib.import_module(name)
    except Exception as error:  # whatever a stranger's module raises when it is executed
        raise _import_error(reference, f"the module {name}", error) from error


def _import_file(reference: str, file: Path) -> ModuleType:
    """Execute a file as a module, once, under a name that its path decides (compiled code is kept by that name)."""
    path = file.resolve()
    name = f"kraft_vehicle_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError.of(reference, f"there is no file {file}", "expected the path of a Python file")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:  # so that it can import its neighbours, as a script can
        sys.path.append(str(path.parent))
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a stranger's file raises when it is executed
        del sys.modules[name]
        raise _import_error(reference, str(file), error) from error
    return module


def _import_error(reference: str, what: str, error: Exception) -> InputError:
    frames = traceback.extract_tb(error.__traceback__)
    inside = [f for f in frames if "importlib" not in f.filename and f.filename != __file__]
    own = [f for f in inside if "/ompl_ext/" not in f.filename] or inside
    place = f" at {own[-1].filename}:{own[-1].lineno}" if own else ""
    problem = f"{what} does not import: {type(error).__name__}: {error}{place}"
    return InputError.of(reference, problem, "expected code that defines a Vehicle")


def _attribute(module: ModuleType, attribute: str, reference: str) -> Vehicle:
    vehicles = _vehicles(module)
    if not hasattr(module, attribute):
        expected = choose(attribute, vehicles, none="expected the name of a Vehicle, and it defines none")
        raise InputError.of(reference, f"there is no {attribute} in {_place(module)}", expected)
    value = getattr(module, attribute)
    if not isinstance(value, Vehicle):
        expected = choose(attribute, vehicles, none="expected an ompl_ext.vehicle.Vehicle")
        raise InputError.of(reference, f"{attribute} is of type {type(value).__name__}, not a Vehicle", expected)
    return value


def _only(module: ModuleType, reference: str) -> Vehicle:
    vehicles = _vehicles(module)
    if len(vehicles) != 1:
        found = f"defines {len(vehicles)} vehicles" if vehicles else "defines no Vehicle"
        expected = f"expected one of {', '.join(f'{reference}:{name}' for name in vehicles)}"
        if not vehicles:
            expected = "expected a module-level ompl_ext.vehicle.Vehicle"
        raise InputError.of(reference, found, expected)
    return next(iter(vehicles.values()))


def _vehicles(module: ModuleType) -> dict[str, Vehicle]:
    return {name: value for name, value in vars(module).items() if isinstance(value, Vehicle)}


def _place(module: ModuleType) -> str:
    return str(module.__file__ or module.__name__)
