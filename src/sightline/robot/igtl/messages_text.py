"""STATUS, STRING, COMMAND with its reply, and CAPABILITY: text messages."""

import struct
from dataclasses import dataclass
from typing import Self

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
    def read(cls, content: bytes) -> Self:
        """Read 30 bytes and the text, which may end with zeros but contains none."""
        reader = Reader(content)
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
    def read(cls, content: bytes) -> Self:
        """Read encoding, length, bytes."""
        reader = Reader(content)
        encoding, length = reader.unpack("HH")
        text = reader.encoded_text(length, encoding)
        reader.finish()
        return cls(text)

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
    def read(cls, content: bytes) -> Self:
        """Read number, name, encoding, length, bytes."""
        return cls(*_read_command(content))

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
    def read(cls, content: bytes) -> Self:
        """Read the layout of a command."""
        return cls(*_read_command(content))

    def content(self) -> bytes:
        """Return the layout of a command."""
        return _command_bytes(self.command_id, self.error, self.text)


@dataclass(frozen=True)
class Capability:
    """Names of the types that the sender understands."""

    type_name = "CAPABILITY"
    types: tuple[str, ...]

    @classmethod
    def read(cls, content: bytes) -> Self:
        """Read 12 bytes per type."""
        reader, types = Reader(content), []
        while reader.left:
            types.append(reader.text(TYPE_BYTES))
        return cls(tuple(types))

    def content(self) -> bytes:
        """Return 12 bytes per type."""
        return b"".join(field(name, TYPE_BYTES, "type") for name in self.types)


def _read_command(content: bytes) -> tuple[int, str, str]:
    reader = Reader(content)
    (number,), name, (encoding, length) = reader.unpack("I"), reader.text(128), reader.unpack("HI")
    text = reader.encoded_text(length, encoding)
    reader.finish()
    return number, name, text


def _command_bytes(number: int, name: str, text: str) -> bytes:
    encoding, data = encoded(text)
    return struct.pack(">I", number) + field(name, 128, "command name") + struct.pack(">HI", encoding, len(data)) + data
