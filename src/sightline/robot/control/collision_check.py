"""Collision check before motion: a quarter of a second, off the control thread, which does not wait for it."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from sightline.robot.control.insertion import Insertion
from sightline.robot.control.states import Trigger

CheckExecutor = Callable[[Callable[[], None]], "Future[None]"]  # submits the work, as Executor.submit does
MAX_CHECK_S = 1.0  # a motion whose check took longer does not begin [ours]
TARGET = "TARGET"  # name of the outcome for a target's check


@dataclass(frozen=True, eq=False)
class CollisionCheck:
    """Collision check of an insertion for a `client`, starting at the joints `start` (5,). `trigger`: the motion that
    waits for it; None for a target just sent. `result` raises RobotRefusedError with what is in the way."""

    client: int
    trigger: Trigger | None
    insertion: Insertion
    start: np.ndarray
    begun_s: float
    result: "Future[None]"

    @property
    def name(self) -> str:
        """Name of the outcome: the command that waits, or TARGET."""
        return TARGET if self.trigger is None else self.trigger.value


def run_at_once(work: Callable[[], None]) -> "Future[None]":
    """Synchronous executor for callers without a control loop."""
    done: Future[None] = Future()
    try:
        done.set_result(work())
    except Exception as error:
        done.set_exception(error)
    return done
