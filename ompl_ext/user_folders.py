"""Folders of this user: which may be written, and one among the temporary files for users without a home."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def may_write(folder: Path) -> bool:
    """Whether a folder can be written, or made; not below a folder that this user must not enter."""
    nearest = next(path for path in (folder, *folder.parents) if os.path.exists(path))  # False without permission
    return os.access(nearest, os.W_OK | os.X_OK)


def temporary_root() -> Path | None:
    """Folder of this user among the temporary files; None where none can be made."""
    try:
        return Path(tempfile.gettempdir()) / f"kraft-{os.getuid()}"
    except FileNotFoundError:  # a machine that is read-only throughout
        return None


def is_of_another(folder: Path) -> bool:
    """Whether another user has made a folder, and could put files into it."""
    return os.path.lexists(folder) and folder.lstat().st_uid != os.getuid()


def below_home(variable: str, default: str) -> Path | None:
    """Folder that an XDG variable names, or by default one in the home; None for an unknown user without HOME."""
    if given := os.environ.get(variable):
        return Path(given)
    try:
        return Path.home() / default
    except RuntimeError:
        return None
