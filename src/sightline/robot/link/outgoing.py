"""Messages for clients, made of what is to be said to them."""

from dataclasses import dataclass

from sightline.robot import contract
from sightline.robot.igtl import Message, Status, String, Transform
from sightline.robot.igtl.kinds import Body

Saying = tuple[str, Body]  # device name and body of a message
_NAME_BYTES = 20


@dataclass(frozen=True)
class Outgoing:
    """A message for a client. Telemetry may be dropped where the client reads too slowly; answers never."""

    client: int
    message: Message
    telemetry: bool = False


def message_of(name: str, body: Body, version: int) -> Message:
    """A message; with header 2 it says which frame and unit its numbers are in."""
    said: dict[str, str] = {}
    if version == 2 and isinstance(body, Transform):
        frame = contract.MCS if name == contract.MEASURED_CP else contract.CFCS
        said = {contract.UNITS: contract.MM, contract.COORDINATES: frame}
    return Message(body, name, version=version, metadata=said)


def with_mirror(name: str, body: Body) -> list[Saying]:
    """What is said, and where it is a STATUS the same in words."""
    if not isinstance(body, Status):
        return [(name, body)]
    return [(name, body), (contract.MIRRORED, String(f"{name}; {body.code}; {body.error_name}; {body.text}"))]


def echo_of(name: str, body: Body) -> Saying:
    """The acknowledgement of a message named KIND_identifier, by its body."""
    return contract.ACKNOWLEDGED + name.split("_", 1)[1], body


def fitting(name: str) -> str:
    """A device name made of what a client sent: ASCII, and no longer than the field."""
    readable = "".join(letter for letter in name if " " < letter < "\x7f")[:_NAME_BYTES]
    return readable or "UNKNOWN"
