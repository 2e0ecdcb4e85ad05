"""Encoding of text and numbers in OpenIGTLink, and the headers of a message.

Numbers are big-endian, names stand in fields of fixed size padded with zeros. A header has 58 bytes; version 2 adds an
extended header and metadata. Source: the protocol's pages (header, version 1 and 2; timestamp). The CRC covers the body
but not the header: names and types are protected by TCP's checksum only.
"""

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sightline.errors import MessageError

ASCII, UTF8 = 3, 106  # MIBenum of IANA: the two text encodings that are read here
HEADER_BYTES = 58
NAME_BYTES = 20
TYPE_BYTES = 12
VERSIONS = (1, 2)

_HEADER = struct.Struct(">H12s20sQQQ")
_EXTENDED = struct.Struct(">HHII")
_ENTRY = struct.Struct(">HHI")
_TYPE = re.compile(rb"([!-~]{1,12})\0*")  # printable ASCII, then zeros: distinguishes a header from other bytes


class Reader:
    """Reads a message's content once. Raises MessageError if it ends too early, or if bytes are left over."""

    def __init__(self, content: bytes):
        self._content, self._at = content, 0

    @property
    def left(self) -> int:
        """Number of bytes not yet read."""
        return len(self._content) - self._at

    def take(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        if count > self.left:
            raise MessageError(f"ends {count - self.left} bytes too early")
        self._at += count
        return self._content[self._at - count : self._at]

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """Return big-endian numbers, with a layout in `struct`'s format characters."""
        return struct.unpack(">" + layout, self.take(struct.calcsize(">" + layout)))

    def text(self, size: int) -> str:
        """Return the text in a field of `size` bytes, up to the first zero."""
        return text_of(self.take(size).split(b"\0", 1)[0])

    def encoded_text(self, length: int, encoding: int) -> str:
        """Return a text of `length` bytes in a stated encoding."""
        if encoding not in (ASCII, UTF8):
            raise MessageError(f"its text has encoding {encoding}; only US-ASCII (3) and UTF-8 (106) are read")
        return text_of(self.take(length))  # as UTF-8 in both cases: some peers send it and call it ASCII

    def floats(self, *shape: int) -> np.ndarray:
        """Return 32-bit floats as float64."""
        with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
            return np.frombuffer(self.take(4 * math.prod(shape)), dtype=">f4").astype(np.float64).reshape(shape)

    def doubles(self, *shape: int) -> np.ndarray:
        """Return 64-bit floats."""
        return np.frombuffer(self.take(8 * math.prod(shape)), dtype=">f8").astype(np.float64).reshape(shape)

    def finish(self) -> None:
        """Check that everything was read."""
        if self.left:
            raise MessageError(f"is {self.left} bytes too long")


def text_of(data: bytes) -> str:
    """Return bytes decoded as UTF-8. Raises MessageError."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise MessageError(f"holds text that is not UTF-8: {data[:24]!r}") from error


def field(text: str, size: int, what: str) -> bytes:
    """Return a text in a field of `size` bytes. Raises MessageError if it does not fit, rather than cut a name."""
    data = text.encode("utf-8")
    if len(data) > size:
        raise MessageError(f"{what} {text!r} has {len(data)} bytes; at most {size} fit")
    if b"\0" in data:
        raise MessageError(f"{what} {text!r} holds a zero byte, which ends it")
    return data.ljust(size, b"\0")


def encoded(text: str) -> tuple[int, bytes]:
    """Return (encoding, bytes): US-ASCII if that is enough, else UTF-8."""
    return (ASCII if text.isascii() else UTF8), text.encode("utf-8")


def floats(values: np.ndarray) -> bytes:
    """Return 32-bit floats as bytes. Raises MessageError for a finite number that is too large."""
    try:
        with np.errstate(over="raise", invalid="ignore"):
            return np.asarray(values, dtype=np.float64).astype(">f4").tobytes()
    except FloatingPointError as error:
        raise MessageError("a number is too large for the 32 bits of the wire") from error


def read_only(values: Any, what: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return a read-only copy as float64. Raises MessageError for another shape; None in `shape` allows any size."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape and (
        array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True))
    ):
        raise MessageError(f"{what} has shape {array.shape}, not {tuple('any' if n is None else n for n in shape)}")
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Header:
    """A header. `body_bytes`, `crc`: size and CRC of the body. `timestamp`: seconds since 1970 UTC times 2^32; 0 if not
    stated."""

    version: int
    type_name: str
    device_name: str
    timestamp: int
    body_bytes: int
    crc: int

    def encode(self) -> bytes:
        """Return the header in 58 bytes. Raises MessageError if a name does not fit its field."""
        if not self.device_name.isascii():
            raise MessageError(f"device name {self.device_name!r} is not ASCII")
        if not 0 <= self.timestamp < 1 << 64:
            raise MessageError(f"timestamp {self.timestamp} is not a number of 64 bits")
        return _HEADER.pack(
            self.version,
            field(self.type_name, TYPE_BYTES, "type"),
            field(self.device_name, NAME_BYTES, "device name"),
            self.timestamp,
            self.body_bytes,
            self.crc,
        )


def read_header(data: bytes) -> Header:
    """Return the header in 58 bytes. Raises MessageError if they are not a header; the stream is then lost.

    The protocol requires ASCII device names. Another name does not lose the stream: each such byte is read as �.
    """
    version, type_field, name, timestamp, size, crc = _HEADER.unpack(data)
    if version not in VERSIONS:
        raise MessageError(f"header version {version}; only 1 and 2 are read")
    match = _TYPE.fullmatch(type_field)
    if match is None:
        raise MessageError(f"{type_field!r} is not a type name")
    return Header(
        version, match[1].decode("ascii"), name.split(b"\0", 1)[0].decode("ascii", "replace"), timestamp, size, crc
    )


def timestamp_of(time_s: float) -> int:
    """Return the 64-bit timestamp of a time in seconds since 1970 UTC. Raises MessageError outside 1970 to 2106."""
    if not 0 <= time_s < 1 << 32:
        raise MessageError(f"a time of {time_s} s cannot be written: only 1970 to 2106")
    return round(time_s * (1 << 32))


def time_of(timestamp: int) -> float | None:
    """Return seconds since 1970 UTC; None if the sender gave no time."""
    return timestamp / (1 << 32) if timestamp else None


def wrap(content: bytes, message_id: int, metadata: Mapping[str, str]) -> bytes:
    """Return the body of a version 2 message: extended header, content, metadata."""
    entries, texts = [], []
    for key, value in metadata.items():
        name, (encoding, data) = key.encode("utf-8"), encoded(value)
        entries.append(_ENTRY.pack(len(name), encoding, len(data)))
        texts.append(name + data)
    index, text = struct.pack(">H", len(entries)) + b"".join(entries), b"".join(texts)
    return _EXTENDED.pack(_EXTENDED.size, len(index), len(text), message_id) + content + index + text


def unwrap(body: bytes) -> tuple[bytes, int, Mapping[str, str]]:
    """Return (content, message id, metadata) of a version 2 body. Raises MessageError if its sizes do not agree."""
    reader = Reader(body)
    size, index_bytes, text_bytes, message_id = reader.unpack("HHII")
    if size < _EXTENDED.size:
        raise MessageError(f"its extended header claims {size} bytes; it has {_EXTENDED.size} at least")
    reader.take(size - _EXTENDED.size)  # skip fields of later versions
    content = reader.take(max(0, reader.left - index_bytes - text_bytes))
    index, text = Reader(reader.take(index_bytes)), Reader(reader.take(text_bytes))
    metadata: dict[str, str] = {}
    for _ in range(index.unpack("H")[0] if index_bytes else 0):
        key_bytes, encoding, value_bytes = index.unpack("HHI")
        key = text_of(text.take(key_bytes))
        if key in metadata:
            raise MessageError(f"its metadata give {key!r} twice")
        metadata[key] = text.encoded_text(value_bytes, encoding)
    index.finish()
    text.finish()
    return content, message_id, MappingProxyType(metadata)
