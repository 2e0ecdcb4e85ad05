"""Messages of text: STATUS, STRING, COMMAND with its reply, CAPABILITY; and queries GET_, STT_, STP_ and RTS_.

The type field holds twelve characters, so two types are cut in queries: GET_TRANS, GET_CAPABIL.
"""

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

from sightline.errors import MessageError
from sightline.robot.igtl.wire import TYPE_BYTES, Reader, encoded, field, text_of


@dataclass(frozen=True)
class Status:
    """`code`: 1 is good, the others are listed by the protocol; `subcode` and `error_name` are the sender's own."""

    type_name = "STATUS"
    code: int
    error_name: str = ""
    text: str = ""
    subcode: int = 0

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 30 bytes and the text, which may end with zeros but contains none."""
        code, subcode = reader.unpack("Hq")
        error_name, text = reader.text(20), reader.take(reader.left).rstrip(b"\0")
        if b"\0" in text:
            raise MessageError("holds a zero byte within its text")
        return cls(code, error_name, text_of(text), subcode)

    def content(self) -> bytes:
        """Return 30 bytes, the text, a zero."""
        data = self.text.encode("utf-8")
        numbers = struct.pack(">Hq", self.code, self.subcode)
        return numbers + field(self.error_name, 20, "error name") + field(self.text, len(data), "text") + b"\0"


@dataclass(frozen=True)
class String:
    """Text of at most 65,535 bytes."""

    type_name = "STRING"
    text: str

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read encoding, length, bytes."""
        encoding, length = reader.unpack("HH")
        return cls(reader.encoded_text(length, encoding))

    def content(self) -> bytes:
        """Return encoding, length, bytes."""
        encoding, data = encoded(self.text)
        return struct.pack(">HH", encoding, len(data)) + data


@dataclass(frozen=True)
class Command:
    """A command; `text` is mostly XML, and the reply carries the same `command_id`."""

    type_name = "COMMAND"
    command_id: int
    name: str
    text: str

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read number, name, encoding, length, bytes."""
        return cls(*_read_command(reader))

    def content(self) -> bytes:
        """Return number, name, encoding, length, bytes."""
        return _command_bytes(self.command_id, self.name, self.text)


@dataclass(frozen=True)
class CommandReply:
    """The reply to a command. It has the layout of a command, with `error` in place of the name."""

    type_name = "RTS_COMMAND"
    command_id: int
    error: str
    text: str

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read the layout of a command."""
        return cls(*_read_command(reader))

    def content(self) -> bytes:
        """Return the layout of a command."""
        return _command_bytes(self.command_id, self.error, self.text)


@dataclass(frozen=True)
class Capability:
    """Names of the types that the sender understands."""

    type_name = "CAPABILITY"
    types: tuple[str, ...]

    @classmethod
    def read(cls, reader: Reader) -> Self:
        """Read 12 bytes per type."""
        types = []
        while reader.left:
            types.append(reader.text(TYPE_BYTES))
        return cls(tuple(types))

    def content(self) -> bytes:
        """Return 12 bytes per type."""
        return b"".join(field(name, TYPE_BYTES, "type") for name in self.types)


def _read_command(reader: Reader) -> tuple[int, str, str]:
    (number,), name, (encoding, length) = reader.unpack("I"), reader.text(128), reader.unpack("HI")
    return number, name, reader.encoded_text(length, encoding)


def _command_bytes(number: int, name: str, text: str) -> bytes:
    encoding, data = encoded(text)
    return struct.pack(">I", number) + field(name, 128, "command name") + struct.pack(">HI", encoding, len(data)) + data


_CUT = {"TRANSFORM": "TRANS", "CAPABILITY": "CAPABIL"}
STREAMED = ("TRANSFORM", "POSITION", "IMAGE", "SENSOR")
QUERIED = (*STREAMED, "STATUS", "CAPABILITY", "POINT", "TRAJ", "STRING", "NDARRAY")


@dataclass(frozen=True)
class Query:
    """A query about messages of the type `of`; most have no content."""

    PREFIX: ClassVar[str] = ""
    TYPES: ClassVar[tuple[str, ...]] = STREAMED
    of: str

    @property
    def type_name(self) -> str:
        """Its type on the wire."""
        return self.type_for(self.of)

    @classmethod
    def type_for(cls, of: str) -> str:
        """Return the type on the wire of this query about `of`. Raises MessageError if there is none."""
        if of not in cls.TYPES:
            raise MessageError(f"{cls.PREFIX} is not defined for {of!r}; it is for {', '.join(cls.TYPES)}")
        return cls.PREFIX + _CUT.get(of, of)

    @classmethod
    def read(cls, of: str, reader: Reader) -> Self:
        """Read empty content."""
        return cls(of)

    def content(self) -> bytes:
        """Return empty content."""
        return b""


@dataclass(frozen=True)
class Get(Query):
    """Query for one message of a type; the header's device name selects the device, an empty one any device."""

    PREFIX = "GET_"
    TYPES = QUERIED


@dataclass(frozen=True)
class Start(Query):
    """Request for a stream of messages. `interval`, for SENSOR: least time between them, in seconds times 2^32; None
    leaves it to the sender."""

    PREFIX = "STT_"
    interval: int | None = None

    @classmethod
    def read(cls, of: str, reader: Reader) -> Self:
        """Read empty content or the interval."""
        return cls(of, reader.unpack("Q")[0] if of == "SENSOR" and reader.left else None)

    def content(self) -> bytes:
        """Return empty content or the interval."""
        if self.interval is None:
            return b""
        if self.of != "SENSOR":
            raise MessageError(f"STT_ of {self.of} carries no interval: {self}")
        return struct.pack(">Q", self.interval)


@dataclass(frozen=True)
class Stop(Query):
    """Request to end a stream of messages."""

    PREFIX = "STP_"


@dataclass(frozen=True)
class Started(Query):
    """Reply whether a stream was started or stopped as requested; `code` 0 is success, 1 an error."""

    PREFIX = "RTS_"
    code: int = 0

    @classmethod
    def read(cls, of: str, reader: Reader) -> Self:
        """Read one byte."""
        return cls(of, *reader.unpack("B"))

    def content(self) -> bytes:
        """Return one byte."""
        return struct.pack(">B", self.code)


@dataclass(frozen=True)
class Missing:
    """The answer to a query if there are no data: a message of the requested type without content."""

    of: str

    @property
    def type_name(self) -> str:
        """Its type on the wire."""
        return self.of

    def content(self) -> bytes:
        """Return empty content."""
        return b""


QUERIES: dict[str, tuple[type[Query], str]] = {
    query.type_for(of): (query, of) for query in (Get, Start, Stop, Started) for of in query.TYPES
}  # by their type on the wire
