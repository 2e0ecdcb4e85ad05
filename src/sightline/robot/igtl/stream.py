"""Decoder of an OpenIGTLink byte stream, without sockets or clocks."""

from dataclasses import dataclass
from enum import Enum

from fastcrc.crc64 import ecma_182

from sightline.errors import MessageError
from sightline.robot.igtl.header import HEADER_BYTES, Header, read_header
from sightline.robot.igtl.messages import Message, decode, is_known, seeming_text

MAX_BODY_BYTES = 16 << 20  # [ours] twice an image of 2048 x 2048 with 16 bits, the largest that C-arms make


class Fault(Enum):
    """Reasons to reject received bytes."""

    NO_HEADER = "no header"
    TOO_LARGE = "too large"
    WRONG_CRC = "wrong CRC"
    UNKNOWN_TYPE = "unknown type"
    BAD_BODY = "bad body"


@dataclass(frozen=True)
class Rejected:
    """Received bytes that are not a valid message, with the reason. `header` is None if it could not be read. `text`:
    the apparent text of a STRING; act on it only if it asks to stop."""

    fault: Fault
    reason: str
    header: Header | None = None
    text: str = ""

    @property
    def fatal(self) -> bool:
        """Whether nothing after it can be read, so that the connection must be closed."""
        return self.fault in (Fault.NO_HEADER, Fault.TOO_LARGE)


Event = Message | Rejected


class Stream:
    """The decoder of one connection. Feed it the received bytes, in pieces of any size.

    OpenIGTLink does not mark the beginning of a message: only the size in a header tells where the next one starts.
    After a wrong CRC, an unknown type or a bad body, the next message is read where the header says, which is usually
    right. If no header is found there, or if a size is above the limit, the place of the next message is lost: the last
    event is fatal, nothing more is read, and the connection must be closed. Searching for bytes that look like a header
    would obey messages inside the text of others.

    A wrong size within the limit makes the stream wait for bytes that never come or belong to later messages. The
    stream has no clock: the owner of the connection must close it if `partial` lasts too long.
    """

    def __init__(self, max_body_bytes: int = MAX_BODY_BYTES):
        self._limit = max_body_bytes
        self._buffer = bytearray()
        self._header: Header | None = None
        self._lost = False

    @property
    def partial(self) -> bool:
        """Whether a message has begun but is not complete."""
        return bool(self._buffer) or self._header is not None

    def feed(self, data: bytes) -> list[Event]:
        """Add bytes and return the completed events in order. Raises MessageError after a fatal event."""
        if self._lost:
            raise MessageError("the place of the next message is lost; close the connection")
        self._buffer += data
        events, at = [], 0
        while not self._lost:
            needed = HEADER_BYTES if self._header is None else self._header.body_bytes
            if len(self._buffer) - at < needed:
                break
            piece = bytes(memoryview(self._buffer)[at : at + needed])
            at += needed
            events += self._read_body(self._header, piece) if self._header is not None else self._read_header(piece)
        del self._buffer[:at]
        if self._lost:
            self._buffer.clear()
        return events

    def _read_header(self, data: bytes) -> list[Event]:
        try:
            header = read_header(data)
        except MessageError as error:
            self._lost = True
            return [Rejected(Fault.NO_HEADER, str(error))]
        if header.body_bytes > self._limit:
            self._lost = True
            reason = f"{header.body_bytes} bytes announced; at most {self._limit} are read"
            return [Rejected(Fault.TOO_LARGE, reason, header)]
        self._header = header
        return []

    def _read_body(self, header: Header, body: bytes) -> list[Event]:
        self._header = None
        if ecma_182(body) != header.crc:
            reason = f"the {header.type_name} was altered on its way"
            return [Rejected(Fault.WRONG_CRC, reason, header, seeming_text(header, body))]
        if not is_known(header.type_name):
            return [Rejected(Fault.UNKNOWN_TYPE, f"{header.type_name} is not read here", header)]
        try:
            return [decode(header, body)]
        except MessageError as error:
            reason = f"the {header.type_name} {error}"
            return [Rejected(Fault.BAD_BODY, reason, header, seeming_text(header, body))]
