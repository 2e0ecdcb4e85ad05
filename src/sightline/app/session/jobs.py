"""Long-running work, notification of the pages, and messages for errors."""

import asyncio
import traceback
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

from sightline.app import texts
from sightline.errors import RobotRefusedError, SightlineError, UnusableInputError


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


T = TypeVar("T")


class Jobs:
    """`working`: the current work that belongs to no single image, empty if none; `trouble`: the error of the last one.
    `listeners` are called on the event loop whenever something that a page shows has changed."""

    def __init__(self) -> None:
        self.listeners: list[Callable[[], None]] = []
        self.working = ""
        self.trouble = ""
        self._tasks: set[asyncio.Task[None]] = set()

    def notify(self) -> None:
        """Call all listeners. Must run on the event loop."""
        for listener in list(self.listeners):
            listener()

    def forget(self, listener: Callable[[], None]) -> None:
        """Remove a listener, if it is one."""
        self.listeners[:] = [one for one in self.listeners if one != listener]

    def refuse_more(self) -> None:
        """Raise UnusableInputError while work is running."""
        if self.working:
            raise UnusableInputError(f"wait: {self.working} is not done yet")

    async def during(self, what: str, work: Callable[[], Awaitable[T]]) -> T:
        """Run work while pages show `what`, and return its result. Pages also show its error. Raises
        UnusableInputError, without starting it, while other work is running."""
        self.refuse_more()
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
