"""Work that takes longer than a click, and the pages that are told of it."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

from sightline.app.session.failures import report, sentence_of
from sightline.errors import UnusableInputError

T = TypeVar("T")


class Jobs:
    """`working`: what is being done that belongs to no single image, empty at rest; `trouble`: why the last of it
    failed. `listeners` are called on the event loop whenever something that a page shows has changed."""

    def __init__(self) -> None:
        self.listeners: list[Callable[[], None]] = []
        self.working = ""
        self.trouble = ""
        self._tasks: set[asyncio.Task[None]] = set()

    def notify(self) -> None:
        """Tell every listener that something has changed. Called on the event loop."""
        for listener in list(self.listeners):
            listener()

    async def during(self, what: str, work: Callable[[], Awaitable[T]]) -> T:
        """Start work and await it while pages say what it is; return its result. Pages show an error that it raises.
        Raises UnusableInputError while other work goes on, and then starts nothing."""
        if self.working:
            raise UnusableInputError(f"{self.working} is not done yet; wait for it")
        self.working, self.trouble = what, ""
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
        """Start work that nobody awaits; pages show an error that it raises."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the loop itself holds it weakly
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if isinstance(error, Exception):
            self.trouble = report(error)
            self.notify()
