"""What waits to be sent to one peer, in order and within bounds."""

from sightline.errors import LinkError

TELEMETRY_MESSAGES = 64  # [ours] a third of a second at 200 Hz: what is older tells nobody anything
ANSWER_BYTES = 1 << 20  # [ours] thousands of answers: who has not read these reads none


class Outbox:
    """Messages waiting. Of telemetry the oldest is dropped where too much waits; an answer never is."""

    def __init__(self):
        self.dropped = 0  # telemetry, since the beginning
        self._waiting: dict[int, bytes] = {}  # by number: answers and telemetry keep one order
        self._telemetry: dict[int, None] = {}  # the numbers of telemetry, oldest first
        self._answer_bytes = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put_answer(self, data: bytes) -> None:
        """Raises LinkError where so many answers wait that the peer cannot be reading."""
        if self._answer_bytes + len(data) > ANSWER_BYTES and self._answer_bytes:
            raise LinkError(f"the peer does not read: {self._answer_bytes} bytes of answers wait for it")
        self._answer_bytes += len(data)
        self._put(data)

    def put_telemetry(self, data: bytes) -> None:
        """The newest stays."""
        if len(self._telemetry) == TELEMETRY_MESSAGES:
            oldest = next(iter(self._telemetry))
            del self._telemetry[oldest], self._waiting[oldest]
            self.dropped += 1
        self._telemetry[self._next] = None
        self._put(data)

    def take(self) -> bytes:
        """The next to be sent. Raises KeyError where nothing waits."""
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
