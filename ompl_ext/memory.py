"""Memory of this machine that a process may still use."""

from __future__ import annotations

import os
import resource
from pathlib import Path

GROUP = Path("/sys/fs/cgroup")


class MapTooLargeError(MemoryError):
    """A workspace whose maps need more memory than there is; `needed` and `available` are in bytes."""

    def __init__(self, needed: int, available: int) -> None:
        self.needed, self.available = needed, available
        super().__init__(f"the maps need {in_words(needed)} of memory, and {in_words(available)} are available")


def in_words(size: int) -> str:
    """Size in bytes with a unit, such as 1.2 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{max(size / 1e6, 0.0):.0f} MB"


def available_memory() -> int:
    """Bytes that this process can still allocate: free ones of the machine, of its control group, of its limit."""
    limits = [_free_of_machine()]
    limit, used = _number(GROUP / "memory.max"), _number(GROUP / "memory.current")
    if limit is not None and used is not None:
        limits.append(limit - used + _reclaimable(GROUP / "memory.stat"))
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most != resource.RLIM_INFINITY:
        limits.append(most - _address_space())
    return max(min(limits), 0)


def check_memory(needed: int) -> None:
    """Check that `needed` bytes are available.

    Raises:
        MapTooLargeError: they are not.
    """
    available = available_memory()
    if needed > available:
        raise MapTooLargeError(needed, available)


def _reclaimable(stat: Path) -> int:
    """Bytes that a control group counts as used and gives back when they are needed: files that were read long ago."""
    try:
        lines = stat.read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("inactive_file ")), 0)


def _free_of_machine() -> int:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux: what is installed is the only limit that is known
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    sizes = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
    return 1024 * sizes["MemAvailable"]


def _address_space() -> int:
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[0]
    except OSError:  # not Linux
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _number(path: Path) -> int | None:
    """Number in a file; None if there is no such file or it says that there is no limit."""
    try:
        text = path.read_text(encoding="ascii").strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None
