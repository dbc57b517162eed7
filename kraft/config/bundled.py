"""The files that come with kraft: scenarios, vehicles and methods, by name."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Final, Literal, TypeAlias

from kraft.config.yaml_reader import read_document
from kraft.errors import Code, InputError, MissingAsset
from kraft.text import nearest, suggestion

Kind: TypeAlias = Literal["scenario", "vehicle", "method"]

_FOLDERS: Final[dict[Kind, str]] = {
    "scenario": "scenarios",
    "vehicle": "configs/vehicles",
    "method": "configs/methods",
}
_SUFFIXES: Final = (".yaml", ".yml")


@cache
def root() -> Path:
    """Return the folder that holds ``scenarios/`` and ``configs/``.

    An installed kraft carries them inside the package; a checkout has them at its top.

    Raises:
        MissingAsset: if neither is there.
    """
    package = Path(__file__).resolve().parent.parent
    for candidate in (package / "_bundled", package.parent):
        if (candidate / "scenarios").is_dir() and (candidate / "configs").is_dir():
            return candidate
    raise MissingAsset(f"kraft's own scenarios and configs are not in {package / '_bundled'}; reinstall kraft")


def folder(kind: Kind) -> Path:
    """Folder of all bundled files of one kind."""
    return root() / _FOLDERS[kind]


def names(kind: Kind) -> tuple[str, ...]:
    """Names of all bundled files of one kind, sorted."""
    return tuple(sorted(path.stem for path in folder(kind).glob("*.yaml")))


def descriptions(kind: Kind) -> dict[str, str]:
    """Map each name to the ``description`` its file gives (without checking the rest of the file)."""
    result = {}
    for name in names(kind):
        data = read_document(folder(kind) / f"{name}.yaml").data
        text = data.get("description") if isinstance(data, dict) else None
        result[name] = " ".join(text.split()) if isinstance(text, str) else ""
    return result


def find(kind: Kind, name_or_path: str | Path) -> Path:
    """Return the file that a name or path means.

    A word without a folder and without ``.yaml`` is a bundled name; everything else is a path.

    Raises:
        InputError: if there is no such name or file, with the nearest one there is.
    """
    if isinstance(name_or_path, str) and is_name(name_or_path):
        if name_or_path in names(kind):
            return folder(kind) / f"{name_or_path}.yaml"
        expected = suggestion(name_or_path, names(kind), none=f"no {kind} comes with kraft")
        problem = f"there is no {kind} of this name"
        raise InputError.of(name_or_path, problem, f"{expected} (or the path of a .yaml file)", Code.NOT_FOUND)
    path = Path(name_or_path)
    if not os.path.exists(path):
        raise InputError.of(str(path), "there is no such file", _nearby(kind, path), Code.NOT_FOUND)
    return path


def is_name(text: str) -> bool:
    """Whether ``text`` reads as a bundled name rather than as a path."""
    return "/" not in text and "\\" not in text and not text.endswith(_SUFFIXES)


def _nearby(kind: Kind, path: Path) -> str:
    """Suggest a file of the same folder, or a bundled name."""
    try:
        siblings = [p.name for p in path.parent.iterdir() if p.suffix in _SUFFIXES]
    except (OSError, ValueError):  # the folder is missing or closed to us: suggest nothing from it
        siblings = []
    if near := nearest(path.name, siblings):
        return f"did you mean {str(path.parent / near)!r}?"
    if near := nearest(path.stem, names(kind)):
        return f"expected the path of a .yaml file (kraft's own {kind} is called {near!r})"
    return f"expected the path of a .yaml file or the name of a {kind}"
