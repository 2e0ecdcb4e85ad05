"""What clients send, in the order in which it is handled, and the answers that were given already."""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.requests import Answer
from sightline.robot.control.states import Trigger
from sightline.robot.igtl import Event, Message, Rejected, String

STOPPING = (Trigger.STOP.value, Trigger.EMERGENCY.value)
_TEXT = 100  # characters of a request that are compared: no valid request is longer [ours]


class Change(Enum):
    """Arrival or departure of a client."""

    JOINED = "joined"
    LEFT = "left"


@dataclass(frozen=True, eq=False)
class InboxItem:
    """A client's message, arrival or departure. `overtaken`: a stop that was sent later is handled before it."""

    client: int
    what: Event | Change
    overtaken: bool = False


@dataclass(eq=False)
class _Queue:
    """One client's queue: waiting items, oldest first, with their numbers; and the number of its departure."""

    waiting: deque[tuple[int, InboxItem]] = field(default_factory=deque)
    left: int | None = None


class Inbox:
    """Messages from one thread to another. Each client has its own queue and the queues are served in turn, so that a
    client that sends much delays no other."""

    def __init__(self) -> None:
        self._next = 0  # number of the next item; written only by the thread that puts
        self._stops: deque[tuple[int, InboxItem]] = deque()
        self._queues: dict[int, _Queue] = {}
        self._stopped = -1  # number of the last stop that was handled

    def put(self, client: int, what: Event | Change) -> None:
        """Add a message, or the arrival or departure of a client."""
        stop = stop_of(what)
        if stop is not None:
            self._stops.append((self._next, InboxItem(client, stop)))
        else:
            queue = self._queues.setdefault(client, _Queue())
            if what is Change.LEFT:
                queue.left = self._next
            else:
                queue.waiting.append((self._next, InboxItem(client, what)))
        self._next += 1

    def __len__(self) -> int:
        queues = list(self._queues.values())
        return len(self._stops) + sum(len(queue.waiting) + (queue.left is not None) for queue in queues)

    def waiting(self, client: int) -> int:
        """Return the number of this client's waiting messages, without stops."""
        queue = self._queues.get(client)
        return 0 if queue is None else len(queue.waiting)

    @property
    def stop_waits(self) -> bool:
        """Whether a stop is waiting."""
        return bool(self._stops)

    def batch(self, most: int, waits: Callable[[], int | None] = lambda: None) -> Iterator[InboxItem]:
        """Yield the items of one cycle: all stops, then departures, then at most `most` of the other items that came
        before the cycle began. The client that `waits` for an answer is served once it has it; a client that left is
        not served any more."""
        end = self._next
        for _ in range(len(self._stops)):
            self._stopped, heard = self._stops.popleft()
            yield heard
        if not any(queue.waiting or queue.left is not None for queue in list(self._queues.values())):
            return
        for client, queue in list(self._queues.items()):
            if queue.left is not None and queue.left < end:
                del self._queues[client]
                yield InboxItem(client, Change.LEFT)
        served: Counter[int] = Counter()
        for _ in range(most):
            waiting = waits()
            heads = [
                (served[client], queue.waiting[0][0], client)
                for client, queue in list(self._queues.items())
                if queue.waiting and queue.waiting[0][0] < end and client != waiting
            ]
            if not heads:
                return
            *_, client = min(heads)
            served[client] += 1
            number, heard = self._queues[client].waiting.popleft()
            yield InboxItem(client, heard.what, number < self._stopped)


def stop_of(what: Event | Change) -> Message | None:
    """Return the stop command in an event, also if its CRC is wrong; None if it is not one."""
    if isinstance(what, Rejected) and what.header is not None and what.header.device_name.isascii():
        what = Message(String(what.text), what.header.device_name, version=what.header.version)
    if not (isinstance(what, Message) and isinstance(what.body, String)):
        return None
    named = what.device_name.startswith(contract.COMMAND)
    return what if named and stop_word(what.body.text) is not None else None


def stop_word(text: str) -> str | None:
    """Return STOP or EMERGENCY if the text is one, ignoring case, surrounding space and all after a zero byte; else
    None."""
    word = text.split("\0", maxsplit=1)[0].strip().upper()
    return word if word in STOPPING else None


class AnswerCache:
    """The newest requests of one connection with their answers, by identifier."""

    def __init__(self) -> None:
        self._entries: OrderedDict[str, tuple[str, Answer]] = OrderedDict()

    def earlier(self, identifier: str, text: str) -> Answer | None:
        """Return the answer to a repeated request, a refusal if the identifier belongs to another request, or None if
        it is new."""
        if identifier not in self._entries:
            return None
        first, answer = self._entries[identifier]
        if first == text[:_TEXT]:
            return answer
        reason = f"{identifier[:20]} was {first[:20]!r} before; give every request an identifier of its own"
        return Answer(Code.CONFIGURATION, reason)

    def put(self, identifier: str, text: str, answer: Answer) -> None:
        """Store a request with its answer."""
        self._entries[identifier] = (text[:_TEXT], answer)
        self._entries.move_to_end(identifier)
        if len(self._entries) > contract.MAX_KEPT:
            self._entries.popitem(last=False)

    def ended(self, text: str, answer: Answer) -> None:
        """Replace the answer of the newest unfinished request of this text."""
        for identifier, (first, earlier) in reversed(self._entries.items()):
            if first == text and not earlier.done:
                self._entries[identifier] = (first, answer)
                return
