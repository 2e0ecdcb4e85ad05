"""Threads: several for kernels that release the GIL, one for the linear algebra."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any

from numba import config
from threadpoolctl import threadpool_limits

THREADS: int = config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
# Of every estimate. Its matrices are small, so that idle threads cost more than they bring: twice the time of a view.
# And a sum that is split between threads has other last bits on another number of cores.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
_SHARES = 8  # parts per thread, to balance the load: a bead's fit may take five times as long as another's [ours]


def in_parts(kernel: Callable[..., object], *arguments: object) -> None:
    """Call kernel(part, parts, *arguments) for every part; the kernel must release the GIL (nogil).

    Not numba's parallel loops: they take twice as long to compile, and busy waiting is slow next to other programs.
    The calling thread takes parts too: on a busy machine the others may start too late to help, and are not waited for.
    """
    if THREADS == 1:
        kernel(0, 1, *arguments)
        return
    parts = _SHARES * THREADS
    left = iter(range(parts))

    def work() -> None:
        for part in left:  # the interpreter's lock gives each part to one thread
            kernel(part, parts, *arguments)

    helpers = [_pool(os.getpid()).submit(work) for _ in range(THREADS - 1)]
    try:
        work()
    finally:
        started = [helper for helper in helpers if not helper.cancel()]
        wait(started)
    for helper in started:
        helper.result()


def at_once(*jobs: Callable[[], Any]) -> list[Any]:
    """Return the results of `jobs`, which several threads run; jobs that hold the GIL wait for each other."""
    results: list[Any] = [None] * len(jobs)

    def work(part: int, parts: int) -> None:
        for k in range(part, len(jobs), parts):
            results[k] = jobs[k]()

    in_parts(work)
    return results


@cache
def _pool(process: int) -> ThreadPoolExecutor:  # one per process: threads do not survive a fork
    return ThreadPoolExecutor(max(THREADS - 1, 1), "sightline")
