"""Work on several threads: kernels that need no interpreter, each call doing a part of the whole."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from numba import config

THREADS: int = config.NUMBA_NUM_THREADS  # pyright: ignore[reportAttributeAccessIssue]
_SHARES = 4  # parts per thread, so that none waits long for another [ours]


def in_parts(kernel: Callable[..., object], *arguments: object) -> None:
    """Call kernel(part, parts, *arguments) for every part; it must release the interpreter (nogil).

    Not numba's own parallel loops: they compile for twice as long, and wait by spinning, which is slow where other
    programs run.
    """
    if THREADS == 1:
        kernel(0, 1, *arguments)
        return
    parts = _SHARES * THREADS
    for done in [_pool(os.getpid()).submit(kernel, part, parts, *arguments) for part in range(parts)]:
        done.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:  # one for each: threads do not outlive a fork
    return ThreadPoolExecutor(THREADS, "sightline")
