"""The heavy work in a process of its own, so that the page stays alive while beads are found and views calibrated."""

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from multiprocessing.connection import wait
from typing import Any, TypeVar

from sightline.errors import RefusedError

T = TypeVar("T")


class Workshop:
    """`await workshop.do(function, *arguments)`: one thing at a time, in the order asked. Functions and arguments are
    passed by name and value; close it at the end."""

    def __init__(self) -> None:
        self._pool = self._start()

    async def do(self, function: Callable[..., T], *arguments: Any) -> T:
        """What the function returns; raises what it raises, and RefusedError where its process died."""
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._pool, function, *arguments)
        except BrokenProcessPool as error:
            self._pool = self._start()
            raise RefusedError(
                "the process that reads images ended before it was done (too little memory?); it was started anew: "
                "open the image again"
            ) from error

    def close(self) -> None:
        """End the process; what was asked and not begun is dropped."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        # Spawned, not forked: the page's process has threads.
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    """A page that is killed takes its workshop along."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_for, args=[parent.sentinel], name="parent", daemon=True).start()


def _wait_for(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


def warm_up() -> None:
    """Import what the first image would wait for."""
    for name in ("calibration", "case.views", "detection.wire"):
        import_module(f"sightline.{name}")
