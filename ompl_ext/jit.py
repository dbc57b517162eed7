"""Compilation with numba: strict IEEE arithmetic, and machine code that is kept on disk (`kernel_cache`).

*Arithmetic.*  No `fastmath`: without reassociation or contraction every lane of a vectorised loop computes exactly
what the scalar loop would, so results do not depend on the machine's vector width.  `error_model="numpy"` only
removes the zero-division branch that would keep a loop from vectorising.

*Memory.*  `_nrt=False` compiles without numba's memory runtime: a kernel can neither allocate nor count references.

*Garbage.*  While numba compiles, Python collects no cyclic garbage: the collections find little and take an eighth of
the time.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core import cgutils, event
from numba.core.caching import NullCache
from numba.core.registry import CPUDispatcher
from numba.core.typeinfer import register_dispatcher
from numba.extending import intrinsic

from ompl_ext.kernel_cache import KernelCache, cache_folder

_njit: Any = numba.njit  # numba's stubs lack `_nrt` and the configuration
_codegen: Any = cgutils
_intrinsic: Any = intrinsic
_event: Any = event
_typed_while: Any = register_dispatcher
F = TypeVar("F", bound=Callable[..., object])


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


def compiled(function: F, *, folder: Path | None = None, signature: object = None, nogil: bool = True) -> F:
    """Compile `function` with numba and keep the machine code in `folder`.

    With `nogil` it releases Python's global lock, so that several threads can run kernels at the same time.

    With a `signature` it is compiled, or loaded from the cache, at once; otherwise on its first call.

    Raises:
        CacheError: it has to be compiled and cannot be kept, or a file in `folder` is damaged.
    """
    dispatcher: Any = _njit(error_model="numpy", nogil=nogil, _nrt=False)(function)
    dispatcher.__class__ = _Kernel
    dispatcher.keep(folder or cache_folder(), signature)
    return cast(F, dispatcher)


class _Kernel(CPUDispatcher):
    """Function whose machine code is kept on disk."""

    _cache: Any  # numba's stubs lack it

    def keep(self, folder: Path, signature: Any = None) -> None:
        """Keep the machine code in `folder`; with a signature compile for it alone, or load what is kept.

        Raises:
            CacheError: it has to be compiled and cannot be kept, or a file in `folder` is damaged.
        """
        self._cache = KernelCache.of(self.py_func, folder)
        if signature is not None:
            with _typed_while(self):
                self.compile(signature)
            self.disable_compile()


class _Part(_Kernel):
    """Function for use in kernels, compiled without the wrappers that Python calls.

    For the tree's arrays the wrappers take longer to compile than the function.  When it is called from Python (tests,
    experiments), it is compiled once more, with them.
    """

    @cached_property
    def _from_python(self) -> Callable[..., object]:
        dispatcher: Callable[..., object] = _njit(error_model="numpy", _nrt=False)(self.py_func)
        return dispatcher

    def __call__(self, *arguments: object) -> object:
        return self._from_python(*arguments)

    def compile(self, sig: Any) -> Any:
        """Compile for a signature; what is the same for every vehicle is cached from here on, not at the import."""
        if self.is_shared and not self.is_cached:
            self.keep(cache_folder())
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
        CacheError: it has to be compiled and cannot be kept, or a file in `folder` is damaged.
    """
    options = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    dispatcher: Any = _njit(error_model="numpy", _nrt=False, **options)(function)
    dispatcher.__class__ = _Kernel
    dispatcher.keep(folder, signature)
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
