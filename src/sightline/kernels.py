"""Kernels: functions that numba compiles, and keeps on the disk for the processes to come.

Results are bit-identical for the same image, whichever kernel is compiled first. Three properties of numba stand in the
way. It takes unstated options (fastmath, error model, inlining) from the caller that is compiled first. The linker may
call any loaded copy of a function that is not inlined, whichever caller it was compiled with; the last bits of fastmath
differ between copies. And numba's own functions (whole powers, hypot, sums) state no options. Therefore all options are
stated; fastmath is used only in kernels that Python calls, or that are inlined there; and it computes with operators
and intrinsics alone (sqrt, exp, log).
"""

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

import numba as nb
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature

FAST = {"reassoc", "contract", "arcp", "nsz"}  # the part of fastmath that keeps NaN and infinity
_STATED: dict[str, Any] = {"fastmath": False, "error_model": "python", "forceinline": False}  # numba's defaults


class _Kept(FunctionCache):
    """A kernel's compiled code on the disk, with two faults of numba's cache mended.

    It asks only whether the kernel's own file is the same. But what the kernel calls or reads in other files may have
    changed, by a new version of this package: old code would be run. And of two processes that add to it at once, one
    may name the other's file: code would be run with arguments of other types.
    """

    def __init__(self, kernel: CPUDispatcher) -> None:
        super().__init__(kernel.py_func)
        self._kernel = kernel

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        fields = tuple(getattr(one, "fields", ()) for one in normalize_signature(sig)[0])  # of named tuples, in order
        return (*super()._index_key(sig, codegen), fields, _made_from(self._kernel))

    def holds_any(self) -> bool:
        """Return whether there is code for any types, made from the present sources."""
        index = self._cache_file._load_index()  # pyright: ignore[reportPrivateUsage]
        return any(key[-1] == _made_from(self._kernel) for key in index)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is not None and tuple(found.signature.args) != tuple(normalize_signature(sig)[0]):
            return None
        return found


@cache
def _made_from(kernel: CPUDispatcher) -> str:
    """Return a hash of the files of a kernel and of those that it calls, and of the constants they read."""
    return sha256("\n".join(sorted(_parts(kernel))).encode()).hexdigest()


@cache
def _parts(kernel: CPUDispatcher) -> frozenset[str]:
    function, found = kernel.py_func, {_source(__file__), _source(kernel.py_func.__code__.co_filename)}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, CPUDispatcher):
            found |= _parts(value)
        elif isinstance(value, ModuleType):
            found.add(_source(getattr(value, "__file__", None) or ""))
        elif isinstance(value, np.ndarray):
            found.add(f"{name} {value.dtype} {value.shape} {sha256(value.tobytes()).hexdigest()}")
        else:
            found.add(f"{name} {getattr(value, '_fields', value)!r}")
    return frozenset(found)


@cache
def _source(path: str) -> str:
    file = Path(path)  # not there in a frozen program, of which numba compares the whole
    return sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function for the types of its arguments, with numba's `options`."""

    def compiled(function: Callable[..., Any]) -> Any:
        one = nb.njit(**(_STATED | options))(function)
        if isinstance(one, CPUDispatcher):  # else numba is told to compile nothing
            vars(one)["_cache"] = _Kept(one)  # as its option `cache` does
        return one

    return compiled


def is_compiled(function: Callable[..., Any]) -> bool:
    """Return whether a kernel is on the disk for some types, or numba compiles nothing."""
    kept = vars(function).get("_cache")
    return not isinstance(kept, _Kept) or kept.holds_any()


exact = kernel()
exact_unchecked = kernel(error_model="numpy")
# For what is called a thousand times an image: each call of another kernel counts the references to its arrays, and
# atomic counters stall the processor.
inlined = kernel(forceinline=True)
fast = kernel(fastmath=FAST, error_model="numpy", forceinline=True)
# Inlined before compilation; otherwise a function with one caller would be compiled twice.
part_of_caller = kernel(inline="always")


@part_of_caller
def squared(x):
    """Return x * x, as numba's own powers may not be used with fastmath."""
    return x * x
