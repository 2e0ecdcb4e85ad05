"""A worker process for detection and calibration, so that the page stays responsive."""

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import wait
from typing import Any, TypeVar

import numpy as np

from sightline.errors import RefusedError, SightlineError

T = TypeVar("T")
_DRAWN_PX, _APART_PX, _DISC_PX = 256, 64, 7.0  # of an image with 16 discs as large as beads [ours]


class WorkerProcess:
    """`await worker.do(function, *arguments)` runs one function at a time, in order. Functions and arguments are
    pickled; close the worker at the end."""

    def __init__(self) -> None:
        self._pool = self._start()

    async def do(self, function: Callable[..., T], *arguments: Any) -> T:
        """Return what the function returns. Raises what it raises, and RefusedError if its process died."""
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._pool, function, *arguments)
        except BrokenProcessPool as error:
            self._pool = self._start()
            raise RefusedError(
                "open the image again: the process that reads images ended early (too little memory?) and was restarted"
            ) from error

    def begin(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Start a function ahead of its need; what it returns or raises is dropped."""
        self._pool.submit(function, *arguments)

    def close(self) -> None:
        """End the process, after the function at work; those that wait are dropped."""
        # Python waits for the pool at its own end too, but wakes the pool's thread through a pipe that this thread may
        # be closing just then: OSError, bad file descriptor.
        self._pool.shutdown(wait=True, cancel_futures=True)

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        # Spawned, not forked: the page's process has threads.
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this process when its parent is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_for, args=[parent.sentinel], name="parent", daemon=True).start()


def _wait_for(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


def warm_up() -> None:
    """Import what the first image needs, and compile it where no program has before, by looking for drawn discs."""
    for name in ("calibration", "case.views", "detection.wires.wire"):
        import_module(f"sightline.{name}")
    from sightline.from_images.pipeline import find_beads
    from sightline.imaging import Radiograph

    v, u = np.mgrid[:_DRAWN_PX, :_DRAWN_PX] % _APART_PX - _APART_PX / 2
    discs = 40000.0 - 20000.0 * (np.hypot(u, v) < _DISC_PX)
    with suppress(SightlineError):
        find_beads(Radiograph(discs.astype(np.uint16), 65535.0))
