"""Bounded queue of messages to one peer."""

from sightline.errors import LinkError

TELEMETRY_MESSAGES = 64  # [ours] a third of a second at 200 Hz: older telemetry is useless
ANSWER_BYTES = 1 << 20  # [ours] thousands of answers: a peer that has not read these reads none


class Outbox:
    """Waiting messages. If too much telemetry waits, the oldest is dropped; answers are never dropped."""

    def __init__(self):
        self.dropped = 0  # number of dropped telemetry messages
        self._waiting: dict[int, bytes] = {}  # by number, in common order of answers and telemetry
        self._telemetry: dict[int, None] = {}  # the numbers of telemetry, oldest first
        self._answer_bytes = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put_answer(self, data: bytes) -> None:
        """Add an answer. Raises LinkError if so many answers wait that the peer cannot be reading."""
        if self._answer_bytes + len(data) > ANSWER_BYTES and self._answer_bytes:
            raise LinkError(f"the peer does not read: {self._answer_bytes} bytes of answers wait for it")
        self._answer_bytes += len(data)
        self._put(data)

    def put_telemetry(self, data: bytes) -> None:
        """Add telemetry; the oldest is dropped if too much waits."""
        if len(self._telemetry) == TELEMETRY_MESSAGES:
            oldest = next(iter(self._telemetry))
            del self._telemetry[oldest], self._waiting[oldest]
            self.dropped += 1
        self._telemetry[self._next] = None
        self._put(data)

    def take(self) -> bytes:
        """Remove and return the next message. Raises KeyError if nothing waits."""
        number = next(iter(self._waiting), None)
        if number is None:
            raise KeyError("nothing waits")
        data = self._waiting.pop(number)
        if number in self._telemetry:
            del self._telemetry[number]
        else:
            self._answer_bytes -= len(data)
        return data

    def _put(self, data: bytes) -> None:
        self._waiting[self._next] = data
        self._next += 1
