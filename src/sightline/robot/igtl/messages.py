"""Complete messages: encoding, decoding, the table of message types, and the decoder of a byte stream."""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Protocol

from fastcrc.crc64 import ecma_182

from sightline.errors import MessageError
from sightline.robot.igtl.messages_arrays import Image, NDArray, Points, Position, Sensor, Trajectories, Transform
from sightline.robot.igtl.messages_text import (
    QUERIED,
    QUERIES,
    Capability,
    Command,
    CommandReply,
    Missing,
    Status,
    String,
)
from sightline.robot.igtl.wire import HEADER_BYTES, VERSIONS, Header, Reader, read_header, time_of, unwrap, wrap

LONG_NAME = "IGTL_DEVICE_NAME"  # metadata key in which PLUS gives the full name cut to 20 bytes in the header
MAX_BODY_BYTES = 2 * (2048 * 2048 * 2)  # twice the largest image that C-arms make: 2048 x 2048 pixels of 2 bytes


class Body(Protocol):
    """The body of a message: a frozen value with its type name and its encoding."""

    @property
    def type_name(self) -> str:
        """Its type on the wire, at most twelve characters."""
        ...

    def content(self) -> bytes:
        """Return its bytes without headers and metadata. Raises MessageError, ValueError or struct.error if it cannot
        be encoded."""
        ...


READERS: dict[str, Callable[[Reader], Body]] = {
    body.type_name: body.read
    for body in (
        Transform, Position, Points, Trajectories, Status, String, Command, CommandReply, Capability, Sensor, NDArray,
        Image,
    )
}  # fmt: skip
_LISTS = ("POINT", "TRAJ", "CAPABILITY")  # without content these are empty lists, not missing data


@dataclass(frozen=True)
class Message:
    """A body with its header. `timestamp`: seconds since 1970 UTC times 2^32, 0 where not stated (see `timestamp_of`).

    `message_id` and `metadata` travel with version 2 only.
    """

    body: Body
    device_name: str = ""
    timestamp: int = 0
    version: int = 1
    message_id: int = 0
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self):
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))

    @property
    def type_name(self) -> str:
        """The body's type on the wire."""
        return self.body.type_name

    @property
    def name(self) -> str:
        """The device name, in full if the metadata give it and the header's name is its beginning."""
        full = self.metadata.get(LONG_NAME, "")
        return full if full.startswith(self.device_name) and full else self.device_name

    @property
    def time_s(self) -> float | None:
        """Seconds since 1970 UTC; None if not stated."""
        return time_of(self.timestamp)


def encode(message: Message) -> bytes:
    """Return the bytes of a message. Raises MessageError rather than cut, drop or round a value to infinity."""
    if message.version not in VERSIONS:
        raise MessageError(f"header version {message.version}; only 1 and 2 are written")
    if message.version == 1 and (message.metadata or message.message_id):
        raise MessageError("metadata and a message id travel with header version 2 only")
    try:
        body = message.body.content()
        if message.version == 2:
            body = wrap(body, message.message_id, message.metadata)
        header = Header(
            message.version, message.type_name, message.device_name, message.timestamp, len(body), ecma_182(body)
        )
        return header.encode() + body
    except (struct.error, ValueError, OverflowError) as error:
        raise MessageError(f"the {message.type_name} cannot be written: {error}") from error


def decode(header: Header, body: bytes) -> Message:
    """Return the message from its header and body, whose CRC was checked and whose type is known.

    Raises MessageError for a malformed body or a device name that is not ASCII.
    """
    if not header.device_name.isascii():
        raise MessageError(f"has a device name that is not ASCII: {header.device_name!r}")
    content, message_id, metadata = (body, 0, {}) if header.version == 1 else unwrap(body)
    return Message(
        _read_content(header.type_name, content),
        header.device_name,
        header.timestamp,
        header.version,
        message_id,
        metadata,
    )


def _read_content(type_name: str, content: bytes) -> Body:
    reader = Reader(content)
    if type_name in QUERIES:
        query, of = QUERIES[type_name]
        body = query.read(of, reader)
    elif not content and type_name in QUERIED and type_name not in _LISTS:
        body = Missing(type_name)
    else:
        body = READERS[type_name](reader)
    reader.finish()
    return body


def seeming_text(header: Header, body: bytes) -> str:
    """Return the apparent text of a malformed STRING, after its encoding and length; "" for other types."""
    if header.type_name != String.type_name:
        return ""
    try:
        content = body if header.version == 1 else unwrap(body)[0]
    except (MessageError, struct.error):
        return ""
    return content[4:].decode("latin-1")


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
        if header.type_name not in READERS and header.type_name not in QUERIES:
            return [Rejected(Fault.UNKNOWN_TYPE, f"{header.type_name} is not read here", header)]
        try:
            return [decode(header, body)]
        except MessageError as error:
            reason = f"the {header.type_name} {error}"
            return [Rejected(Fault.BAD_BODY, reason, header, seeming_text(header, body))]
