"""Paths in the values of a scenario's keys, which begin at the folder of the file that states them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from kraft.config import bundled
from kraft.config.document import Value
from kraft.config.overrides import Override
from kraft.config.source import KeyPath
from kraft.config.user_code import split_file
from kraft.files import path_from

PATHS: Final = (("vehicle",), ("truth", "model"), ("truth", "mjcf"), ("obstacles", int, "map", "file"))
"""Keys whose values are names, code or paths; `int` is an index."""


def value_here(override: Override) -> Value:
    """Value of an override that means the same in the working directory: its paths begin there."""
    folder = override.place.folder
    return override.value if folder is None else _moved(override.path, override.value, folder)


def _moved(key: KeyPath, value: Value, folder: Path) -> Value:
    """A value with the paths in it, which begin at `folder`, as paths from the working directory."""
    if isinstance(value, dict):
        return {name: _moved((*key, name), each, folder) for name, each in value.items()}
    if isinstance(value, tuple):
        return tuple(_moved((*key, i), each, folder) for i, each in enumerate(value))
    return _reference(value, folder) if isinstance(value, str) and _is_path(key) else value


def _is_path(key: KeyPath) -> bool:
    """Whether the value of a key, in which an index stands for any, is a reference."""
    return tuple(int if isinstance(each, int) else each for each in key) in PATHS


def _reference(text: str, folder: Path) -> str:
    """A path from the working directory; a name or a module as it is."""
    if text in bundled.names("vehicle"):
        return text
    file, attribute = split_file(text) or (text, "")
    path = path_from(folder, file)
    return str(path) + (f":{attribute}" if attribute else "") if os.path.isfile(path) else text
