"""Bundled scenarios, vehicles, methods, suites and robots by name."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Final, Literal, TypeAlias

from kraft.errors import Code, InputError, MissingAsset
from kraft.text import nearest, suggestion

Kind: TypeAlias = Literal["scenario", "vehicle", "method", "suite", "robot"]

_FOLDERS: Final[dict[Kind, str]] = {
    "scenario": "scenarios",
    "vehicle": "configs/vehicles",
    "method": "configs/methods",
    "suite": "configs/suites",
    "robot": "configs/robots",
}
_SUFFIXES: Final = (".yaml", ".yml")


@cache
def root() -> Path:
    """Folder that holds ``scenarios/`` and ``configs/``: inside an installed package, or at the top of a checkout.

    Raises:
        MissingAsset: if neither exists.
    """
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "_bundled", package.parent):
        if (candidate / "scenarios").is_dir() and (candidate / "configs").is_dir():
            return candidate
    raise MissingAsset(f"the bundled scenarios and configs are not in {package / '_bundled'}; reinstall kraft")


def folder(kind: Kind) -> Path:
    """Folder of all bundled files of one kind."""
    return root() / _FOLDERS[kind]


def names(kind: Kind) -> tuple[str, ...]:
    """Names of all bundled files of one kind, sorted."""
    return tuple(sorted(path.stem for path in folder(kind).glob("*.yaml")))


def descriptions(kind: Kind) -> dict[str, str]:
    """Description of each bundled file by name; the rest of the file is not checked."""
    from kraft.config.yaml_reader import read_document  # loads PyYAML, which names do not need

    result = {}
    for name in names(kind):
        data = read_document(folder(kind) / f"{name}.yaml").data
        text = data.get("description") if isinstance(data, dict) else None
        result[name] = " ".join(text.split()) if isinstance(text, str) else ""
    return result


def find(kind: Kind, name_or_path: str | Path) -> Path:
    """File of a bundled name or a path.

    A word without a folder and without ``.yaml`` is a bundled name; everything else is a path.

    Raises:
        InputError: if there is no such name or file; it suggests the most similar one.
        TypeError: if it is neither text nor a path.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        raise TypeError(f"{kind}: expected a name or a path, not {type(name_or_path).__name__}")
    if isinstance(name_or_path, str) and is_name(name_or_path):
        if name_or_path in names(kind):
            return folder(kind) / f"{name_or_path}.yaml"
        if os.path.isdir(name_or_path):
            raise _is_folder(kind, name_or_path)
        if os.path.isfile(name_or_path):
            expected = f"expected the path of a .yaml file or the name of a {kind}"
            raise InputError.of(name_or_path, f"is no {kind} file", expected, Code.MISMATCH)
        problem = f"there is no {kind} of this name"
        if files := [name for suffix in _SUFFIXES if os.path.isfile(name := name_or_path + suffix)]:
            raise InputError.of(name_or_path, problem, f"did you mean the file {files[0]!r}?", Code.NOT_FOUND)
        expected = suggestion(name_or_path, names(kind), none=f"no {kind} is bundled")
        raise InputError.of(name_or_path, problem, f"{expected} (or the path of a .yaml file)", Code.NOT_FOUND)
    path = Path(name_or_path)
    if os.path.islink(path) and not os.path.exists(path):
        problem = f"is a link to {os.readlink(path)}, which does not exist"
        raise InputError.of(str(path), problem, "expected a link to a file that exists", Code.NOT_FOUND)
    if not os.path.exists(path):
        raise InputError.of(str(path), "there is no such file", _nearby(kind, path), Code.NOT_FOUND)
    if os.path.isdir(path):
        raise _is_folder(kind, str(path))
    return path


def _is_folder(kind: Kind, path: str) -> InputError:
    expected = f"expected the path of a .yaml file or the name of a {kind}"
    return InputError.of(path, "is a folder", expected, Code.MISMATCH)


def is_name(text: str) -> bool:
    """Whether ``text`` has the form of a bundled name rather than of a path."""
    return "/" not in text and "\\" not in text and not text.endswith(_SUFFIXES)


def _nearby(kind: Kind, path: Path) -> str:
    """Suggestion of a file in the same folder, or of a bundled name."""
    try:
        siblings = {p.stem: p.name for p in path.parent.iterdir() if p.suffix in _SUFFIXES}
    except (OSError, ValueError):  # the folder is missing or unreadable: no suggestion from it
        siblings = {}
    if near := nearest(path.stem, siblings):  # without the suffix, which makes all names similar
        return f"did you mean {str(path.parent / siblings[near])!r}?"
    if near := nearest(path.stem, names(kind)):
        return f"expected the path of a .yaml file (there is a bundled {kind} {near!r})"
    return f"expected the path of a .yaml file or the name of a {kind}"
