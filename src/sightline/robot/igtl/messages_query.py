"""GET_, STT_, STP_ and RTS_: query a message, start and stop a stream of messages, and the reply to these.

The type field holds twelve characters, so two types are cut in queries: GET_TRANS, GET_CAPABIL.
"""

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader

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
    def read(cls, of: str, content: bytes) -> Self:
        """Read empty content."""
        Reader(content).finish()
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
    def read(cls, of: str, content: bytes) -> Self:
        """Read empty content or the interval."""
        reader = Reader(content)
        interval = reader.unpack("Q")[0] if of == "SENSOR" and content else None
        reader.finish()
        return cls(of, interval)

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
    def read(cls, of: str, content: bytes) -> Self:
        """Read one byte."""
        reader = Reader(content)
        (code,) = reader.unpack("B")
        reader.finish()
        return cls(of, code)

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
