"""Threads: several for kernels that release the GIL, one for the linear algebra."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from numba import config
from threadpoolctl import threadpool_limits

THREADS: int = config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
# Of every estimate. Its matrices are small, so that idle threads cost more than they bring: twice the time of a view.
# And a sum that is split between threads has other last bits on another number of cores.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
_SHARES = 4  # parts per thread, to balance the load [ours]


def in_parts(kernel: Callable[..., object], *arguments: object) -> None:
    """Call kernel(part, parts, *arguments) for every part; the kernel must release the GIL (nogil).

    Not numba's parallel loops: they take twice as long to compile, and busy waiting is slow next to other programs.
    """
    if THREADS == 1:
        kernel(0, 1, *arguments)
        return
    parts = _SHARES * THREADS
    for done in [_pool(os.getpid()).submit(kernel, part, parts, *arguments) for part in range(parts)]:
        done.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:  # one per process: threads do not survive a fork
    return ThreadPoolExecutor(THREADS, "sightline")
