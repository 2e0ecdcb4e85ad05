"""Long-running work, some in a worker process so that the page stays responsive; notification of the pages, and
messages for errors."""

import asyncio
import multiprocessing
import traceback
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from sightline.app import texts
from sightline.common.closing import end_with_parent
from sightline.errors import RefusedError, RobotRefusedError, SightlineError, UnusableInputError

T = TypeVar("T")


def sentence_of(error: Exception) -> str:
    """Return the message for an error: its own sentence, of a robot's refusal the reason without codes, or for a defect
    that something in Sightline failed."""
    if isinstance(error, RobotRefusedError) and error.reason:
        return f"The robot refused: {error.reason}."
    return (
        texts.titled(str(error))
        if isinstance(error, SightlineError)
        else (
            "Reload the page and report this: something in Sightline failed "
            f"({type(error).__name__}). The plan is unchanged."
        )
    )


def report(error: Exception) -> str:
    """Return the message for an error. A defect of Sightline is also printed with its traceback."""
    if not isinstance(error, SightlineError):
        traceback.print_exception(error)
    return sentence_of(error)


def failure_of(work: Callable[[], object]) -> str:
    """Run `work` and return the message of its error; empty if there was none."""
    try:
        work()
    except Exception as error:
        return report(error)
    return ""


class Jobs:
    """`working`: the current work that belongs to no single image, empty if none; `began`: its start, s of the
    monotonic clock; `trouble`: the error of the last one. `listeners` are called on the event loop whenever something
    that a page shows has changed."""

    def __init__(self) -> None:
        self.listeners: list[Callable[[], None]] = []
        self.working = ""
        self.began = 0.0
        self.trouble = ""
        self._tasks: set[asyncio.Task[None]] = set()

    def notify(self) -> None:
        """Call all listeners. Must run on the event loop."""
        for listener in list(self.listeners):
            listener()

    def forget(self, listener: Callable[[], None]) -> None:
        """Remove a listener, if it is one."""
        self.listeners[:] = [known for known in self.listeners if known != listener]

    def refuse_more(self) -> None:
        """Raise UnusableInputError while work is running."""
        if self.working:
            raise UnusableInputError(f"wait: {self.working} is not done yet")

    async def during(self, what: str, work: Callable[[], Awaitable[T]]) -> T:
        """Run work while pages show `what`, and return its result. Pages also show its error. Raises
        UnusableInputError, without starting it, while other work is running."""
        self.refuse_more()
        self.working, self.began, self.trouble = what, monotonic(), ""
        self.notify()
        try:
            return await work()
        except Exception as error:
            self.trouble = sentence_of(error)
            raise
        finally:
            self.working = ""
            self.notify()

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Start work in the background; pages show its error."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop holds only a weak reference
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if isinstance(error, Exception):
            self.trouble = report(error)
            self.notify()


_DRAWN_PX, _APART_PX, _DISC_PX = 256, 64, 7.0  # [ours] of an image with 16 discs as large as beads, for a first run


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
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=end_with_parent)


def warm_up() -> None:
    """Import what the first image needs, and compile it where no program has before, by looking for drawn discs."""
    from sightline.case.views import find_beads  # imports all that an image is calibrated with, and a wire found
    from sightline.imaging import Radiograph

    v, u = np.mgrid[:_DRAWN_PX, :_DRAWN_PX] % _APART_PX - _APART_PX / 2
    discs = 40000.0 - 20000.0 * (np.hypot(u, v) < _DISC_PX)
    with suppress(SightlineError):
        find_beads(Radiograph(discs.astype(np.uint16), 65535.0))
