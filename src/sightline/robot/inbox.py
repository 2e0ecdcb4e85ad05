"""What clients sent, in the order in which it is heard: stops first, and nothing moves that a stop came after."""

from collections import deque
from dataclasses import dataclass
from enum import Enum
from itertools import count
from queue import Empty, SimpleQueue

from sightline.robot import contract
from sightline.robot.igtl import Event, Message, String
from sightline.robot.states import Cause

STOPPING = (Cause.STOP.value, Cause.EMERGENCY.value)


class Change(Enum):
    """Of who is there."""

    JOINED = "joined"
    LEFT = "left"


@dataclass(frozen=True, eq=False)
class Heard:
    """What a client sent or did. `overtaken`: a stop that came later was heard before it."""

    client: int
    what: Event | Change
    overtaken: bool = False


class Inbox:
    """One thread puts, another takes."""

    def __init__(self) -> None:
        self._number = count()
        self._stops: SimpleQueue[tuple[int, Heard]] = SimpleQueue()
        self._queue: SimpleQueue[tuple[int, Heard]] = SimpleQueue()
        self._later: deque[tuple[int, Heard]] = deque()  # of a client that waits for an answer
        self._stopped = -1  # number of the last stop that was heard

    def put(self, client: int, what: Event | Change) -> None:
        """Something that came."""
        queue = self._stops if stops(what) else self._queue
        queue.put((next(self._number), Heard(client, what)))

    def __len__(self) -> int:
        return self._stops.qsize() + self._queue.qsize() + len(self._later)

    @property
    def stop_waits(self) -> bool:
        """Whether one is there."""
        return not self._stops.empty()

    def take_stop(self) -> Heard | None:
        """The next, before all else."""
        try:
            self._stopped, heard = self._stops.get_nowait()
        except Empty:
            return None
        return heard

    def take(self, waits: int | None) -> Heard | None:
        """The next. A client that `waits` for an answer is heard when it has it, in order; that it left, at once."""
        for entry in self._later:
            if entry[1].client != waits:
                self._later.remove(entry)
                return self._judged(*entry)
        while True:
            try:
                number, heard = self._queue.get_nowait()
            except Empty:
                return None
            if heard.what is Change.LEFT:
                self._later = deque(entry for entry in self._later if entry[1].client != heard.client)
            elif heard.client == waits:
                self._later.append((number, heard))
                continue
            return self._judged(number, heard)

    def _judged(self, number: int, heard: Heard) -> Heard:
        return Heard(heard.client, heard.what, number < self._stopped)


def stops(what: Event | Change) -> bool:
    """Whether it is a command to stop."""
    return (
        isinstance(what, Message)
        and isinstance(what.body, String)
        and what.device_name.startswith(contract.COMMAND)
        and what.body.text in STOPPING
    )
