"""Compile options of kernels that other kernels call, so that results are bit-identical for the same image.

Two properties of numba make this necessary. It takes unstated options (fastmath, error model, inlining) from the caller
that is compiled first. And the linker may call any loaded copy of a function that is not inlined, whichever caller it
was compiled with; the last bits of fastmath differ between copies. Therefore all options are stated, and fastmath is
used only in kernels that Python calls, or that are inlined there.

numba's own functions state no options either: whole powers, hypot and sums are compiled once in a process, with the
options of their first caller. Therefore fastmath computes with operators and intrinsics alone (sqrt, exp, log).
"""

import numba as nb

FAST = {"reassoc", "contract", "arcp", "nsz"}  # the part of fastmath that keeps NaN and infinity

exact = nb.njit(cache=True, fastmath=False, error_model="python", forceinline=False)
exact_unchecked = nb.njit(cache=True, fastmath=False, error_model="numpy", forceinline=False)
# For what is called a thousand times an image: each call of another kernel counts the references to its arrays, and
# atomic counters stall the processor.
inlined = nb.njit(cache=True, fastmath=False, error_model="python", forceinline=True)
fast = nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
# Inlined before compilation; otherwise a function with one caller would be compiled twice.
part_of_caller = nb.njit(cache=True, inline="always")


@part_of_caller
def squared(x):
    """Return x * x, as numba's own powers may not be used with fastmath."""
    return x * x
