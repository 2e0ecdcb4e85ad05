"""The robot's messages to clients: answers in the dialect of each client, and its reports on itself."""

from dataclasses import dataclass, field

import numpy as np

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.machine import Machine
from sightline.robot.control.requests import Snapshot
from sightline.robot.control.states import phase
from sightline.robot.igtl import MILLIMETRE, NEWTON, Body, Message, NDArray, Sensor, Status, String, Transform
from sightline.robot.igtl.wire import NAME_BYTES

NamedBody = tuple[str, Body]  # device name and body of a message


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
    readable = "".join(letter for letter in name if " " < letter < "\x7f")[:NAME_BYTES]
    return readable or "UNKNOWN"


@dataclass
class Cycles:
    """Statistics of the control loop: cycles, cycles that were late, and the largest delay, s."""

    count: int = 0
    missed: int = 0
    worst_s: float = 0.0


@dataclass(frozen=True)
class Telemetry:
    """Reports on one machine and the timing of its control loop."""

    machine: Machine
    cycles: Cycles = field(default_factory=Cycles)

    def current(self) -> Status:
        """Return CURRENT_STATUS: the phase, with state or fault in the text; always code 1."""
        state, fault = self.machine.state, self.machine.fault
        text = state.value if fault is None else f"fault {fault.number}: {fault.text}"
        return Status(Code.OK, phase(state), text, subcode=0 if fault is None else fault.number)

    def state_now(self) -> NamedBody:
        """Return the answer to a status query: named after the phase, with the code of its fault."""
        status, fault = self.current(), self.machine.fault
        code = Code.OK if fault is None else fault.code
        late = f"; {self.cycles.missed} of {self.cycles.count} cycles were late"
        return phase(self.machine.state), Status(code, status.error_name, status.text + late, status.subcode)

    def position(self) -> NamedBody:
        """Return the wire's pose, CFCS; before a registration, a STATUS that refuses."""
        registration = self.machine.registration
        if registration is None:
            text = (
                f"no registration, so no position in {contract.CFCS}; {contract.MEASURED_CP} has it in {contract.MCS}"
            )
            return contract.CURRENT_POSITION, Status(Code.NOT_READY, "UNCALIBRATED", text)
        tool = self.machine.robot.manipulator.tool_matrix(self.machine.q)
        return contract.CURRENT_POSITION, Transform(registration.T_mcs_cfcs.inv().as_matrix() @ tool)

    def joints(self, now: Snapshot) -> NamedBody:
        """Return (6, n): position, velocity, commanded position, commanded velocity, lower and upper limit; mm, rad."""
        lower, upper = self.machine.robot.manipulator.lower, self.machine.robot.manipulator.upper
        rows = np.stack([now.reading.encoders, now.velocity, now.wanted, now.commanded, lower, upper])
        return contract.MEASURED_JS, NDArray(rows)

    def streams(self, now: Snapshot) -> list[NamedBody]:
        """Return all streams except the pose in CFCS."""
        tool = self.machine.robot.manipulator.tool_matrix(now.reading.encoders)
        bodies: list[NamedBody] = [
            (contract.MEASURED_CP, Transform(tool)),
            self.joints(now),
            (contract.FORCE, Sensor(np.array([now.reading.force_n]), NEWTON)),
            (contract.CYCLES, Sensor(np.array([self.cycles.count, self.cycles.missed, self.cycles.worst_s]))),
            (contract.CURRENT_STATUS, self.current()),
        ]
        for name, value in ((contract.DEPTH_SD, now.depth_sd_mm), (contract.DEPTH, now.depth_mm)):
            if value is not None:
                bodies.append((name, Sensor(np.array([value]), MILLIMETRE)))
        if now.guide_off is not None:
            bodies.append((contract.GUIDE_OFF, Sensor(np.array(now.guide_off))))
        return bodies
