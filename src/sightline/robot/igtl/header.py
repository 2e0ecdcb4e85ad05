"""The header of a message, 58 bytes, and from version 2 the extended header and metadata.

Source: the protocol's pages (header, version 1 and 2; timestamp). The CRC covers the body but not the header: names and
types are protected by TCP's checksum only.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from sightline.errors import MessageError
from sightline.robot.igtl.wire import Reader, encoded, field, text_of

HEADER_BYTES = 58
NAME_BYTES = 20
TYPE_BYTES = 12
VERSIONS = (1, 2)

_HEADER = struct.Struct(">H12s20sQQQ")
_EXTENDED = struct.Struct(">HHII")
_ENTRY = struct.Struct(">HHI")
_TYPE = re.compile(rb"([!-~]{1,12})\0*")  # printable ASCII, then zeros: distinguishes a header from other bytes


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
    version, kind, name, timestamp, size, crc = _HEADER.unpack(data)
    if version not in VERSIONS:
        raise MessageError(f"header version {version}; only 1 and 2 are read")
    match = _TYPE.fullmatch(kind)
    if match is None:
        raise MessageError(f"{kind!r} is not a type name")
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
