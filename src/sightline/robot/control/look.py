"""The look for collisions before anything moves: a quarter of a second, beside the loop, which does not wait for it."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from sightline.robot.control.insertion import Insertion
from sightline.robot.control.states import Cause

Surveyor = Callable[[Callable[[], None]], "Future[None]"]  # starts the work, somewhere
LONGEST_S = 1.0  # a motion begins so soon after its command, or not at all [ours]
TARGET = "TARGET"  # name of the answer where it is a target that is looked at


@dataclass(frozen=True, eq=False)
class Look:
    """At an insertion for a `client`, from the joints `start` (5,). `cause`: the motion that waits for it, None for a
    target just sent. `result` raises RobotRefusedError with what is in the way."""

    client: int
    cause: Cause | None
    insertion: Insertion
    start: np.ndarray
    begun_s: float
    result: "Future[None]"

    @property
    def name(self) -> str:
        """Of what is answered."""
        return TARGET if self.cause is None else self.cause.value


def at_once(work: Callable[[], None]) -> "Future[None]":
    """A surveyor for who has no loop to keep."""
    done: Future[None] = Future()
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)
    return done
