"""numba as this package uses it: strict IEEE arithmetic and a cache that cannot go stale.

*Arithmetic.*  No `fastmath`: without reassociation or contraction every lane of a vectorised loop computes exactly
what the scalar loop would, so results do not depend on the machine's vector width.  `error_model="numpy"` only
removes the zero-division branch that would keep a loop from vectorising.

*Memory.*  `_nrt=False` compiles without numba's memory runtime: a kernel can neither allocate nor count references.

*Cache.*  numba keys a cached kernel by its own source file and misses a change in a function it inlined.  Here the
cache folder's name is a hash over the sources of the whole package (and, for a vehicle's kernels, over the vehicle's
source), so an edit anywhere leads to a fresh folder and a stale kernel is impossible.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.registry import CPUDispatcher

from ompl_ext.cache_error import CacheError

_njit: Any = numba.njit  # its stubs know neither `_nrt` nor the configuration
_config: Any = numba.config
F = TypeVar("F", bound=Callable[..., object])


def cache_root() -> Path:
    """Folder that holds all compiled kernels: `$KRAFT_CACHE_DIR`, else the user's cache folder.

    Falls back to a per-user folder under the system's temporary directory where no home folder is writable (containers
    with a read-only home), so that compilation is still paid only once per machine.
    """
    explicit = os.environ.get("KRAFT_CACHE_DIR")
    if explicit:
        return Path(explicit)
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    nearest = next(p for p in (base, *base.parents) if p.exists())
    if os.access(nearest, os.W_OK):
        return base / "kraft"
    return Path(tempfile.gettempdir()) / f"kraft-{os.getuid()}"


@cache
def source_hash() -> str:
    """Hash over every source file of this package and the versions that shape the machine code."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(vehicle_hash: str = "") -> Path:
    """Cache folder of the package's kernels, or of one vehicle's kernels when its hash is given."""
    return cache_root() / "kernels" / source_hash() / (vehicle_hash or "core")


def check_cache(folder: Path) -> None:
    """Make a cache folder and try to write into it.

    Raises:
        CacheError: if that is not possible.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise CacheError(folder, error.strerror or str(error)) from None


def compiled(function: F, *, folder: Path | None = None, signature: object = None) -> F:
    """Compile `function` with numba and keep the machine code in `folder` across processes.

    With a `signature` it is compiled, or loaded from the cache, at once; otherwise on its first call.

    Raises:
        CacheError: if `folder` cannot be written.
    """
    target = folder or cache_folder()
    check_cache(target)
    before = _config.CACHE_DIR
    _config.CACHE_DIR = str(target)  # read once, when njit attaches the cache
    try:
        dispatcher: F = _njit(signature, cache=True, error_model="numpy", _nrt=False)(function)
    finally:
        _config.CACHE_DIR = before
    return dispatcher


class _Part(CPUDispatcher):
    """A function within kernels, without the wrappers through which Python would call it.

    For the tree's arrays these cost more to compile than the function.  Called from Python, as tests and curious people
    do, it is compiled once more, with them.
    """

    @cached_property
    def _from_python(self) -> Callable[..., object]:
        dispatcher: Callable[..., object] = _njit(error_model="numpy", _nrt=False)(self.py_func)
        return dispatcher

    def __call__(self, *arguments: object) -> object:
        return self._from_python(*arguments)


def _part(function: F, **options: bool) -> F:
    dispatcher: Any = _njit(error_model="numpy", _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(
        function
    )
    dispatcher.__class__ = _Part
    return cast(F, dispatcher)


def inlined(function: F) -> F:
    """Compile `function` as a part of the kernels that call it (always inlined, so that their loops vectorise)."""
    return _part(function, forceinline=True)


def part(function: F) -> F:
    """Compile `function` as a part of the kernels that call it, leaving it to LLVM whether to inline it."""
    return _part(function)
