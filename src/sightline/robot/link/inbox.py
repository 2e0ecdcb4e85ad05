"""What clients sent, in the order in which it is heard: stops first, and nothing moves that a stop came after."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum

from sightline.robot import contract
from sightline.robot.control.states import Cause
from sightline.robot.igtl import Event, Message, Rejected, String

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


@dataclass(eq=False)
class _Line:
    """Of one client: what waits, oldest first, each with its number; and the number of its end."""

    waiting: deque[tuple[int, Heard]] = field(default_factory=deque)
    left: int | None = None


class Inbox:
    """One thread puts, another takes. Each client has a line of its own, and the lines take turns: who sends much
    delays nobody else."""

    def __init__(self) -> None:
        self._next = 0  # numbers count what came; a thread may read this, and the other alone writes it
        self._stops: deque[tuple[int, Heard]] = deque()
        self._lines: dict[int, _Line] = {}
        self._stopped = -1  # number of the last stop that was heard

    def put(self, client: int, what: Event | Change) -> None:
        """Something that came."""
        stop = stop_of(what)
        if stop is not None:
            self._stops.append((self._next, Heard(client, stop)))
        else:
            line = self._lines.setdefault(client, _Line())
            if what is Change.LEFT:
                line.left = self._next
            else:
                line.waiting.append((self._next, Heard(client, what)))
        self._next += 1

    def __len__(self) -> int:
        lines = list(self._lines.values())
        return len(self._stops) + sum(len(line.waiting) + (line.left is not None) for line in lines)

    def waiting(self, client: int) -> int:
        """Messages of this client that were not heard yet, stops aside."""
        line = self._lines.get(client)
        return 0 if line is None else len(line.waiting)

    @property
    def stop_waits(self) -> bool:
        """Whether one is there."""
        return bool(self._stops)

    def turn(self, most: int, waits: Callable[[], int | None] = lambda: None) -> Iterator[Heard]:
        """What is heard in one turn: all stops, then who left, then at most so many of what else came before the turn
        began. A client that `waits` for an answer is heard when it has it; one that left is not heard after that."""
        end = self._next
        for _ in range(len(self._stops)):
            self._stopped, heard = self._stops.popleft()
            yield heard
        for client, line in list(self._lines.items()):
            if line.left is not None and line.left < end:
                del self._lines[client]
                yield Heard(client, Change.LEFT)
        turns: Counter[int] = Counter()
        for _ in range(most):
            waiting = waits()
            heads = [
                (turns[client], line.waiting[0][0], client)
                for client, line in list(self._lines.items())
                if line.waiting and line.waiting[0][0] < end and client != waiting
            ]
            if not heads:
                return
            *_, client = min(heads)
            turns[client] += 1
            number, heard = self._lines[client].waiting.popleft()
            yield Heard(client, heard.what, number < self._stopped)


def stop_of(what: Event | Change) -> Message | None:
    """The command to stop that this is, if it is one: also where its CRC is wrong."""
    if isinstance(what, Rejected) and what.header is not None and what.header.device_name.isascii():
        what = Message(String(what.text), what.header.device_name, version=what.header.version)
    if not (isinstance(what, Message) and isinstance(what.body, String)):
        return None
    named = what.device_name.startswith(contract.COMMAND)
    return what if named and stop_word(what.body.text) is not None else None


def stop_word(text: str) -> str | None:
    """STOP or EMERGENCY where a text reads so, whatever its case, the space around it or what follows a zero."""
    word = text.split("\0", maxsplit=1)[0].strip().upper()
    return word if word in STOPPING else None
