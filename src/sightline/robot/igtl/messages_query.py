"""GET_, STT_, STP_ and RTS_: query a message, start and stop a stream of messages, and the reply to these.

The type field holds twelve characters, so two types are cut in queries: GET_TRANS, GET_CAPABIL.
"""

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader, field

_CUT = {"TRANSFORM": "TRANS", "CAPABILITY": "CAPABIL"}
ASKED_FOR = (
    "TRANSFORM", "POSITION", "IMAGE", "STATUS", "CAPABILITY", "POINT", "TRAJ", "TDATA", "SENSOR", "STRING",
    "NDARRAY", "POLYDATA", "BIND",
)  # fmt: skip
FLOWING = ("TRANSFORM", "POSITION", "IMAGE", "TDATA", "SENSOR", "POLYDATA", "BIND")
_WITH_INTERVAL = ("SENSOR", "POLYDATA", "BIND")


@dataclass(frozen=True)
class _Bare:
    """A query without content."""

    PREFIX: ClassVar[str]
    TYPES: ClassVar[tuple[str, ...]]
    of: str

    @property
    def type_name(self) -> str:
        """Its type on the wire."""
        return _type(self.PREFIX, self.of, self.TYPES)

    @classmethod
    def read(cls, of: str, content: bytes) -> Self:
        """Read empty content."""
        Reader(content).finish()
        return cls(of)

    def content(self) -> bytes:
        """Return empty content."""
        return b""


@dataclass(frozen=True)
class Get(_Bare):
    """Query for one message of a type; the header's device name selects the device, an empty one any device."""

    PREFIX = "GET_"
    TYPES = ASKED_FOR


@dataclass(frozen=True)
class Start:
    """Request for a stream of messages. `interval`: least time between them, in ms for TDATA, else in seconds times
    2^32; None leaves it to the sender. `coordinates`: for TDATA, the requested frame."""

    PREFIX: ClassVar[str] = "STT_"
    of: str
    interval: int | None = None
    coordinates: str = ""

    @property
    def type_name(self) -> str:
        """Its type on the wire."""
        return _type(self.PREFIX, self.of, FLOWING)

    @classmethod
    def read(cls, of: str, content: bytes) -> Self:
        """Read empty content or the interval, for TDATA with the coordinates' name in 32 bytes."""
        reader, interval, coordinates = Reader(content), None, ""
        if of == "TDATA":
            (interval,), coordinates = reader.unpack("I"), reader.text(32)
        elif of in _WITH_INTERVAL and content:
            (interval,) = reader.unpack("Q")
        reader.finish()
        return cls(of, interval, coordinates)

    def content(self) -> bytes:
        """Return empty content or the interval, for TDATA with the coordinates' name in 32 bytes."""
        if self.of == "TDATA":
            return struct.pack(">I", self.interval or 0) + field(self.coordinates, 32, "coordinates")
        if self.coordinates or (self.interval is not None and self.of not in _WITH_INTERVAL):
            raise MessageError(f"STT_ of {self.of} carries no interval or coordinates: {self}")
        return b"" if self.interval is None else struct.pack(">Q", self.interval)


@dataclass(frozen=True)
class Stop(_Bare):
    """Request to end a stream of messages."""

    PREFIX = "STP_"
    TYPES = FLOWING


@dataclass(frozen=True)
class Started:
    """Reply whether a stream was started or stopped as requested; `code` 0 is success, 1 an error."""

    PREFIX: ClassVar[str] = "RTS_"
    of: str
    code: int = 0

    @property
    def type_name(self) -> str:
        """Its type on the wire."""
        return _type(self.PREFIX, self.of, FLOWING)

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


def query_of(type_name: str) -> tuple[type[Get] | type[Start] | type[Stop] | type[Started], str] | None:
    """Return (class, requested type) for a query's type on the wire; None if it is not a query."""
    return _QUERIES.get(type_name)


def _type(prefix: str, of: str, among: tuple[str, ...]) -> str:
    if of not in among:
        raise MessageError(f"{prefix} is not defined for {of!r}; it is for {', '.join(among)}")
    return prefix + _CUT.get(of, of)


_QUERIES = {
    _type(kind.PREFIX, of, among): (kind, of)
    for kind, among in ((Get, ASKED_FOR), (Start, FLOWING), (Stop, FLOWING), (Started, FLOWING))
    for of in among
}
