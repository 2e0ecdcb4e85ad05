"""Outgoing messages for clients, and how they differ for clients that know only the convention of 2013."""

from dataclasses import dataclass

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Body, Message, Status, String, Transform

NamedBody = tuple[str, Body]  # device name and body of a message
_NAME_BYTES = 20


@dataclass(frozen=True)
class Dialect:
    """The variable parts of the robot's answers.

    `tells_entered`: a STATUS is sent on entering PLANNING and CALIBRATION. `tells_reachable`: REACHABLE_TARGET is sent.
    `names_commanded`: CURRENT_STATUS names the phase of a refused command instead of the robot's. `in_manual`: code for
    a motion refused in MANUAL. `own_emergency`: code of STATUS EMERGENCY for the client that sent it. `own_frames`:
    registrations map a base frame of the robot to a patient frame other than CFCS (`Setup.frames`).
    """

    tells_entered: bool = True
    tells_reachable: bool = True
    names_commanded: bool = False
    in_manual: Code = Code.MANUAL
    own_emergency: Code = Code.EMERGENCY
    own_frames: bool = False


SIGHTLINE = Dialect()
BRP2013 = Dialect(
    tells_entered=False,
    tells_reachable=False,
    names_commanded=True,
    in_manual=Code.NOT_READY,
    own_emergency=Code.OK,
    own_frames=True,
)
DIALECTS = {"sightline": SIGHTLINE, "brp2013": BRP2013}


@dataclass(frozen=True)
class Outgoing:
    """A message for a client. Telemetry may be dropped if the client reads too slowly; answers never are."""

    client: int
    message: Message
    telemetry: bool = False


def message_of(name: str, body: Body, version: int) -> Message:
    """Return a message; with header version 2 a pose carries its frame and unit as metadata."""
    metadata: dict[str, str] = {}
    if version == 2 and isinstance(body, Transform):
        frame = contract.MCS if name == contract.MEASURED_CP else contract.CFCS
        metadata = {contract.UNITS: contract.MM, contract.COORDINATES: frame}
    return Message(body, name, version=version, metadata=metadata)


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
