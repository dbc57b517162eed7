"""Provenance of a result: versions of the software and where it came from, and hashes of its inputs."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from importlib.metadata import distribution, version
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
from pydantic import BaseModel

from kraft.text import counted

PLANNING: Final = ("numba", "numpy", "ompl")
"""Distributions that a plan depends on."""
SIMULATION: Final = (*PLANNING, "mujoco", "scipy")
"""Distributions that a trial depends on."""
IDENTIFICATION: Final = ("gtsam", "numba", "numpy", "scipy")
"""Distributions that identified parameters depend on."""

MISSING: Final = object()
"""Stands for a value that is absent."""

_REPEATED_MAX: Final = 200
"""Longest text of two lists that are not equally long to repeat whole, characters."""


def versions(distributions: Iterable[str]) -> dict[str, str]:
    """Versions of kraft, of the named distributions and of Python."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {**{name: version(name) for name in ("kraft", *distributions)}, "python": python}


def install_command(extra: str) -> str:
    """Command that installs an extra from where this kraft was installed: a clone, an archive or an index.

    The name alone would make pip look in an index, which need not have this kraft.
    """
    origin: dict[str, Any] = json.loads(distribution("kraft").read_text("direct_url.json") or "{}")
    wanted, url = f"kraft[{extra}]", origin.get("url", "")
    if "dir_info" in origin and urlsplit(url).scheme == "file":
        folder = url2pathname(urlsplit(url).path)
        constraints = Path(folder) / "constraints.txt"  # of a clone: the versions that kraft was tested with
        options = f"-c {shlex.quote(str(constraints))} " if constraints.is_file() else ""
        options += "-e " if origin["dir_info"].get("editable") else ""  # last: the folder is its value
        return f"pip install {options}{shlex.quote(f'{folder}[{extra}]')}"
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}@{origin['vcs_info']['commit_id']}"
    return f"pip install {shlex.quote(f'{wanted} @ {url}' if url else wanted)}"


def plain(value: Any) -> Any:
    """Value as nested lists and dictionaries; an array as its shape and the hash of its bytes, a number as Python's.

    Fields of a dataclass that comparisons ignore (positions in a file) are ignored here too.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, np.ndarray):
        return [list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value) and not isinstance(value, type):
        return {type(value).__name__: {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.compare}}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def plain_hash(value: Any) -> str:
    """SHA-256 of the plain data of a value."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()


def differences(was: Any, now: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Keys and both values of every difference between two JSON values; a hash only where no value differs.

    Lists of mappings or of lists that are equally long are compared item by item: the key has the index of the item.
    A value that is absent is `MISSING`.
    """
    if isinstance(was, dict) and isinstance(now, dict):
        found = [
            difference
            for key in {**was, **now}
            for difference in differences(was.get(key, MISSING), now.get(key, MISSING), (*path, key))
        ]
        of_values = [difference for difference in found if difference[0][-1] != "sha256"]
        yield from of_values or found
    elif path and _are_comparable_lists(was, now):
        for index, (one, other) in enumerate(zip(was, now, strict=True)):
            yield from differences(one, other, (*path[:-1], f"{path[-1]}[{index}]"))
    elif was != now:
        yield path, was, now


def _are_comparable_lists(was: Any, now: Any) -> bool:
    """Whether two values are lists of as many mappings or lists; coordinates are compared together."""
    both = [was, now]
    if not all(isinstance(value, list) for value in both) or len(was) != len(now):
        return False
    return all(isinstance(item, dict | list) for value in both for item in value)


def difference_text(was: Any, now: Any) -> str:
    """Difference of a value from what it was: ``was 3, is 4 now``."""
    if was is MISSING:
        return f"was absent, is {_json(now)} now"
    if now is MISSING:
        return f"was {_json(was)}, is absent now"
    if (
        isinstance(was, list)
        and isinstance(now, list)
        and len(was) != len(now)
        and len(_json([was, now])) > _REPEATED_MAX
    ):
        return f"was a list of {counted(len(was), 'item')}, is one of {len(now)} now"
    return f"was {_json(was)}, is {_json(now)} now"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
