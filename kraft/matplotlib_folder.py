"""A folder for matplotlib where its own cannot be written; to be imported before matplotlib.

Without one, as with a home that is missing or read-only, matplotlib prints a paragraph, and each process looks for all
fonts again.  `MPLCONFIGDIR` stays as it is where it is set.
"""

from __future__ import annotations

import os
from pathlib import Path

from ompl_ext.user_folders import below_home, is_of_another, temporary_root


def provide_folder() -> None:
    """Let matplotlib use this user's folder among the temporary files, unless it has folders or the user names one."""
    if os.environ.get("MPLCONFIGDIR"):
        return
    usual = below_home("XDG_CONFIG_HOME", ".config"), below_home("XDG_CACHE_HOME", ".cache")
    if all(folder is not None and _can_be_made(folder / "matplotlib") for folder in usual):
        return
    root = temporary_root()
    if root is not None and not is_of_another(root):  # matplotlib runs code that settings in the folder name
        os.environ["MPLCONFIGDIR"] = str(root / "matplotlib")


def _can_be_made(folder: Path) -> bool:
    """Make a folder as matplotlib does at its import, and whether it can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


provide_folder()
