"""Complete messages: body, device name, time and metadata; encoding and decoding."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from sightline.errors import MessageError
from sightline.robot.igtl.crc import crc64
from sightline.robot.igtl.header import VERSIONS, Header, time_of, unwrap, wrap
from sightline.robot.igtl.kinds import Body, is_plain, read_plain
from sightline.robot.igtl.messages_bind import Bind
from sightline.robot.igtl.messages_text import String

LONG_NAME = "IGTL_DEVICE_NAME"  # metadata key in which PLUS gives the full name cut to 20 bytes in the header


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
        return (
            Header(
                message.version, message.type_name, message.device_name, message.timestamp, len(body), crc64(body)
            ).encode()
            + body
        )
    except (struct.error, ValueError, OverflowError) as error:
        raise MessageError(f"the {message.type_name} cannot be written: {error}") from error


def is_known(type_name: str) -> bool:
    """Return whether messages of a type are read here."""
    return type_name == Bind.type_name or is_plain(type_name)


def decode(header: Header, body: bytes) -> Message:
    """Return the message from its header and body, whose CRC was checked and whose type is known.

    Raises MessageError for a malformed body or a device name that is not ASCII.
    """
    if not header.device_name.isascii():
        raise MessageError(f"has a device name that is not ASCII: {header.device_name!r}")
    content, message_id, metadata = (body, 0, {}) if header.version == 1 else unwrap(body)
    is_bind = header.type_name == Bind.type_name and content
    return Message(
        Bind.read(content) if is_bind else read_plain(header.type_name, content),
        header.device_name,
        header.timestamp,
        header.version,
        message_id,
        metadata,
    )


def seeming_text(header: Header, body: bytes) -> str:
    """Return the apparent text of a malformed STRING, after its encoding and length; "" for other types."""
    if header.type_name != String.type_name:
        return ""
    try:
        content = body if header.version == 1 else unwrap(body)[0]
    except (MessageError, struct.error):
        return ""
    return content[4:].decode("latin-1")
