"""Compilation with numba: strict IEEE arithmetic and a cache that cannot become stale.

*Arithmetic.*  No `fastmath`: without reassociation or contraction every lane of a vectorised loop computes exactly
what the scalar loop would, so results do not depend on the machine's vector width.  `error_model="numpy"` only
removes the zero-division branch that would keep a loop from vectorising.

*Vectors.*  LLVM prefers vectors of 256 bits on every Intel processor with AVX-512, because the first ones lowered their
clock for 512 bits.  Those with AVX512-FP16 (Sapphire Rapids and later) do not, and search takes a sixth less time with
them.

*Memory.*  `_nrt=False` compiles without numba's memory runtime: a kernel can neither allocate nor count references.

*Cache.*  numba's key of a cached kernel is its own source file; a change of an inlined function goes unnoticed.  Here
the cache folder's name is a hash over the sources of the whole package (and, for a vehicle's kernels, over the
vehicle's source): after any edit a new folder is used, and a stale kernel is impossible.  numba looks up a kernel by
the path of its source file, so every copy of the package has folders of its own.

*Garbage.*  While numba compiles, Python collects no cyclic garbage: the collections find little and take an eighth of
the time.
"""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba import types
from numba.core import cgutils, event
from numba.core.caching import NullCache
from numba.core.codegen import get_host_cpu_features
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

from ompl_ext.cache_error import CacheError

_njit: Any = numba.njit  # numba's stubs lack `_nrt` and the configuration
_config: Any = numba.config
_codegen: Any = cgutils
_intrinsic: Any = intrinsic
_event: Any = event
_compiler_lock: Any = global_compiler_lock
_host_features: Any = get_host_cpu_features
F = TypeVar("F", bound=Callable[..., object])

WRITABLE: Final = "expected a writable folder with enough space in KRAFT_CACHE_DIR"
DAMAGED: Final = (EOFError, pickle.UnpicklingError)
"""Errors of cached files that are empty, cut off or full of zeros, as after a loss of power."""


class _NoCollections(event.Listener):
    """Keeps Python from collecting cyclic garbage during compilations, which contain each other."""

    def __init__(self) -> None:
        self._running, self._enabled = 0, False

    def on_start(self, event: object) -> None:
        """Pause at the beginning of the outermost compilation (called by numba, under its lock)."""
        if self._running == 0:
            self._enabled = gc.isenabled()
            gc.disable()
        self._running += 1

    def on_end(self, event: object) -> None:
        """Go on at its end, also of one that fails."""
        self._running -= 1
        if self._running == 0 and self._enabled:
            gc.enable()


_event.register("numba:compile", _NoCollections())


def with_wide_vectors(features: str) -> str | None:
    """Features of a processor in LLVM's notation with vectors of 512 bits; None if it is better off without them."""
    return f"{features},-prefer-256-bit" if "+avx512fp16" in features.split(",") else None


if _config.CPU_FEATURES is None and _config.CPU_NAME is None:  # otherwise the user has chosen (NUMBA_CPU_FEATURES)
    _config.CPU_FEATURES = with_wide_vectors(_host_features())


def cache_root() -> Path:
    """Folder that holds all compiled kernels: `$KRAFT_CACHE_DIR`, else the user's cache folder.

    If no home folder is writable (containers with a read-only home, services without one, `sudo` with the home of
    another user), it is a folder of the user under the system's temporary directory, so that kernels are still compiled
    only once per machine.
    """
    explicit = os.environ.get("KRAFT_CACHE_DIR")
    if explicit:
        return Path(explicit)
    base = _user_cache()
    if base is not None and _may_write(base):
        return base / "kraft"
    return _temporary_root()


def _temporary_root() -> Path:
    return Path(tempfile.gettempdir()) / f"kraft-{os.getuid()}"


def _user_cache() -> Path | None:
    """The user's cache folder; None for a user that the system does not know, without HOME."""
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return None


def _may_write(folder: Path) -> bool:
    """Whether a folder can be written, or made; not below a folder that this user must not enter."""
    nearest = next(path for path in (folder, *folder.parents) if os.path.exists(path))  # False without permission
    return os.access(nearest, os.W_OK | os.X_OK)


@cache
def source_hash() -> str:
    """Hash over every source file of this package and the versions of numba and Python."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    package = Path(__file__).parent
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(vehicle_hash: str = "") -> Path:
    """Cache folder of the package's kernels, or of a vehicle's kernels if its hash is passed."""
    location = hashlib.sha256(str(Path(__file__).parent).encode()).hexdigest()[:8]
    return cache_root() / "kernels" / f"{source_hash()}-{location}" / (vehicle_hash or "core")


def check_cache(folder: Path) -> None:
    """Make a cache folder and check that it is writable, and that nobody else has made the one for temporary files.

    Raises:
        CacheError: the folder is not writable, or another user could put code into it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _unwritable(folder, error) from None
    check_owner()


def check_owner() -> None:
    """Check that the cache is this user's where every user may make files, among the temporary ones.

    Raises:
        CacheError: another user has made its folder, and could put code into it.
    """
    root = cache_root()
    if root == _temporary_root() and os.path.lexists(root) and root.lstat().st_uid != os.getuid():
        raise CacheError(root, "belongs to another user, whose code would be run", WRITABLE)


def _unwritable(folder: Path, error: OSError) -> CacheError:
    return CacheError(folder, f"cannot be written: {error.strerror or error}", WRITABLE)


@contextmanager
def _cache_errors(folder: Path) -> Iterator[None]:
    """Name the cache in errors of numba that reads and writes it: these name neither a file nor what to do.

    Raises:
        CacheError: a file in `folder` is damaged or cannot be written.
    """
    try:
        yield
    except CacheError:  # of a function that is compiled as a part
        raise
    except DAMAGED as error:
        advice = "delete this folder, and kraft compiles again"
        raise CacheError(cache_folder().parent, f"has damaged files: {error}", advice) from error
    except OSError as error:
        raise _unwritable(folder, error) from error


def compiled(function: F, *, folder: Path | None = None, signature: object = None, nogil: bool = True) -> F:
    """Compile `function` with numba and cache the machine code in `folder`.

    With `nogil` it releases Python's global lock, so that several threads can run kernels at the same time.

    With a `signature` it is compiled, or loaded from the cache, at once; otherwise on its first call.

    Raises:
        CacheError: `folder` is not writable, or a file in it is damaged.
    """
    target = folder or cache_folder()
    check_cache(target)
    with _caching_in(target):
        dispatcher: Any = _njit(signature, cache=True, error_model="numpy", nogil=nogil, _nrt=False)(function)
    dispatcher.__class__ = _Kernel
    return cast(F, dispatcher)


@contextmanager
def _caching_in(folder: Path) -> Iterator[None]:
    """Make numba cache in `folder` what is decorated meanwhile; other threads that compile wait.

    Raises:
        CacheError: a file in `folder` is damaged or cannot be written.
    """
    with _compiler_lock, _cache_errors(folder):
        before = _config.CACHE_DIR
        _config.CACHE_DIR = str(folder)  # read once, when njit attaches the cache
        try:
            yield
        finally:
            _config.CACHE_DIR = before


class _Kernel(CPUDispatcher):
    """Function for use from Python, whose machine code is kept on disk."""

    _cache: Any  # numba's stubs lack it

    def compile(self, sig: Any) -> Any:
        """Compile for a signature, or load what is cached."""
        with _cache_errors(Path(self._cache.cache_path)):
            return super().compile(sig)


class _Part(CPUDispatcher):
    """Function for use in kernels, compiled without the wrappers that Python calls.

    For the tree's arrays the wrappers take longer to compile than the function.  When it is called from Python (tests,
    experiments), it is compiled once more, with them.
    """

    _cache: Any  # numba's stubs lack it

    @cached_property
    def _from_python(self) -> Callable[..., object]:
        dispatcher: Callable[..., object] = _njit(error_model="numpy", _nrt=False)(self.py_func)
        return dispatcher

    def __call__(self, *arguments: object) -> object:
        return self._from_python(*arguments)

    def compile(self, sig: Any) -> Any:
        """Compile for a signature; what is the same for every vehicle is cached from here on, not at the import."""
        if self.is_shared and not self.is_cached:
            with _caching_in(cache_folder()):
                self.enable_caching()
        with _cache_errors(cache_folder()):
            return super().compile(sig)

    @property
    def is_shared(self) -> bool:
        """Whether it is the same for every vehicle: then it is compiled once for all of them."""
        module = self.py_func.__module__ or ""  # none in code that is generated
        return module.startswith("ompl_ext.kernels.") and "<locals>" not in self.py_func.__qualname__

    @property
    def is_cached(self) -> bool:
        """Whether its machine code is kept on disk."""
        return not isinstance(self._cache, NullCache)


def _part(function: F, **options: bool) -> F:
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    dispatcher: Any = _njit(error_model="numpy", _nrt=False, **options)(function)
    dispatcher.__class__ = _Part
    return cast(F, dispatcher)


def inlined(function: F) -> F:
    """Compile `function` as a part of the kernels that call it (always inlined, so that their loops vectorise)."""
    return _part(function, forceinline=True)


def part(function: F) -> F:
    """Compile `function` as a part of the kernels that call it; LLVM decides whether to inline it."""
    return _part(function)


def callee(function: Any, folder: Path, signature: object) -> int:
    """Address of a function that kernels call with `caller`; compiled for the signature and cached in `folder`.

    Raises:
        CacheError: `folder` is not writable.
    """
    check_cache(folder)
    options = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    with _caching_in(folder):
        dispatcher: Any = _njit(signature, cache=True, error_model="numpy", _nrt=False, **options)(function)
    _callees.append(dispatcher)  # its machine code lives as long as it does
    (overload,) = dispatcher.overloads.values()
    address: int = overload.library.get_pointer_to_function(overload.fndesc.llvm_func_name)
    return address


_callees: list[object] = []


def caller(signature: Any) -> Callable[[int, tuple[object, ...]], Any]:
    """Function `call(address, arguments)` for use in kernels, which calls what `callee` compiled for the signature."""

    @_intrinsic  # type: ignore[untyped-decorator]
    def call(_: Any, address: Any, arguments: Any) -> Any:
        def generate(context: Any, builder: Any, typed: Any, values: Any) -> Any:
            convention, result = context.call_conv, signature.return_type
            kind = convention.get_function_type(result, signature.args).as_pointer()
            given = zip(_codegen.unpack_tuple(builder, values[1]), typed.args[1].types, signature.args, strict=True)
            converted = [context.cast(builder, value, before, after) for value, before, after in given]
            function = builder.inttoptr(values[0], kind)
            status, returned = convention.call_function(builder, function, result, signature.args, converted)
            with _codegen.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return returned

        return signature.return_type(types.int64, arguments), generate

    return cast("Callable[[int, tuple[object, ...]], Any]", call)


def template(function: F) -> F:
    """Put the body of `function` where it is called, before types are inferred.

    For functions that take functions: as parts of their own they would be compiled, with all that they call, only to be
    compiled again in the kernel.
    """
    dispatcher: F = _njit(error_model="numpy", _nrt=False, inline="always")(function)
    return dispatcher
