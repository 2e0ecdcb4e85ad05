"""Outgoing messages for clients, built from a device name and a body."""

from dataclasses import dataclass

from sightline.robot import contract
from sightline.robot.igtl import Body, Message, Status, String, Transform

NamedBody = tuple[str, Body]  # device name and body of a message
_NAME_BYTES = 20


@dataclass(frozen=True)
class Outgoing:
    """A message for a client. Telemetry may be dropped if the client reads too slowly; answers never are."""

    client: int
    message: Message
    telemetry: bool = False


def message_of(name: str, body: Body, version: int) -> Message:
    """Return a message; with header version 2 a pose carries its frame and unit as metadata."""
    said: dict[str, str] = {}
    if version == 2 and isinstance(body, Transform):
        frame = contract.MCS if name == contract.MEASURED_CP else contract.CFCS
        said = {contract.UNITS: contract.MM, contract.COORDINATES: frame}
    return Message(body, name, version=version, metadata=said)


def with_mirror(name: str, body: Body) -> list[NamedBody]:
    """Return the message, followed by its text as a STRING if it is a STATUS."""
    if not isinstance(body, Status):
        return [(name, body)]
    return [(name, body), (contract.MIRRORED, String(f"{name}; {body.code}; {body.error_name}; {body.text}"))]


def echo_of(name: str, body: Body) -> NamedBody:
    """Return the acknowledgement of a message named KIND_identifier: its body under the ACK_ name."""
    return contract.ACKNOWLEDGED + name.split("_", 1)[1], body


def fitting(name: str) -> str:
    """Return a valid device name made from a client's text: ASCII, cut to the field's length."""
    readable = "".join(letter for letter in name if " " < letter < "\x7f")[:_NAME_BYTES]
    return readable or "UNKNOWN"
