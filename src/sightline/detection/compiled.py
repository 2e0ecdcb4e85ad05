"""How kernels are compiled that others call: what they find depends on the image alone, to the bit.

What a function leaves open of fast arithmetic, division by zero and inlining, numba takes from whichever caller is the
first to need it. And of a function that is not inlined the linker calls any copy that a process has loaded, compiled
alone or with one of its callers, now or before; the last bits of fast arithmetic differ between those. So all is
stated, and fast arithmetic stands in kernels that Python calls, or is inlined there.
"""

import numba as nb

FAST = {"reassoc", "contract", "arcp", "nsz"}  # all of fastmath that keeps NaN and infinity

exact = nb.njit(cache=True, fastmath=False, error_model="python", forceinline=False)
exact_unchecked = nb.njit(cache=True, fastmath=False, error_model="numpy", forceinline=False)
fast = nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
# Inlined before it is compiled: by itself a function that is called once would be compiled a second time.
part_of_caller = nb.njit(cache=True, inline="always")
