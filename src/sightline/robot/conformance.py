"""Does a robot keep the contract of docs/robot-link.md? Asked over the link, of any robot; the answer is a table.

Nothing moves but in the dry run, which aligns in air and drills nothing.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from socket import create_connection, socket
from time import monotonic

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.client import RobotClient, Said
from sightline.robot.contract import Code
from sightline.robot.igtl import Message, NDArray, Status, Stream, String, Transform, encode
from sightline.robot.transport import BlockingClient

# Any registration does for refusals: 500 mm from base to hip, as many robots stand.
REGISTRATION = RigidTransform.from_translation([500.0, 0.0, 0.0])
# How far beyond where the wire is now targets of the dry run lie, along it, mm: the first that is reachable is taken.
AHEAD_MM, ASIDE_MM = (130.0, 100.0, 60.0, 30.0), 3.0
HIP_AHEAD_MM = 150.0  # of the wire in its sleeve, as our frame is held; CFCS upright, its +X towards the robot
ARRIVED_MM = 0.5


class Verdict(Enum):
    """Of one question."""

    PASSED = "pass"
    FAILED = "FAIL"
    UNSUPPORTED = "not supported"


@dataclass(frozen=True)
class Finding:
    """One question, its answer, and what was seen."""

    name: str
    verdict: Verdict
    seen: str


class _UnsupportedError(Exception):
    pass


def examine(host: str, port: int) -> Iterator[Finding]:
    """All questions that move nothing, one after the other. Raises LinkError where nobody answers at all."""
    RobotClient(host, port).close()
    for name, question in _QUESTIONS.items():
        yield _ask(name, question, host, port)


def dry_run(host: str, port: int) -> Finding:
    """Aligns to a target in air ahead of the wire, stops, and drills nothing. On robots of the old convention a
    MOVE_TO_TARGET may insert: the caller must have a person's word that nobody is in the way."""
    return _ask("dry run: aligns, and stands", _dry_run, host, port)


def _ask(name: str, question: Callable[[RobotClient], str], host: str, port: int) -> Finding:
    try:
        with RobotClient(host, port) as robot:
            seen = question(robot)
    except _UnsupportedError as why:
        return Finding(name, Verdict.UNSUPPORTED, str(why))
    except (LinkError, RobotRefusedError) as error:
        return Finding(name, Verdict.FAILED, str(error))
    return Finding(name, Verdict.PASSED, seen)


# Each returns what was seen, or raises.


def _starts_up(robot: RobotClient) -> str:
    began = monotonic()
    robot.start_up()
    return f"in {1e3 * (monotonic() - began):.0f} ms"


def _knows_its_phase(robot: RobotClient) -> str:
    robot.start_up()
    said = robot.command("PLANNING").refuse_unless_ok()
    status = robot.status()
    _need(status.code == Code.OK, f"CURRENT_STATUS in PLANNING has code {status.code}")
    return f"PLANNING straight from START_UP; {said.text or status.text or 'no text'}"


def _order(robot: RobotClient) -> str:
    names = []
    with BlockingClient(robot.host, robot.port) as raw:
        raw.send(Message(String("START_UP"), "CMD_77"))
        end = monotonic() + contract.STATUS_S
        while "START_UP" not in names and monotonic() < end:
            event = raw.receive(0.1)
            if isinstance(event, Message):
                names.append(event.device_name)
    wanted = ["ACK_77", contract.CURRENT_STATUS, "START_UP"]
    _need(names == wanted, f"came: {', '.join(names) or 'nothing'}; wanted: {', '.join(wanted)}")
    return "ACK, CURRENT_STATUS, STATUS"


def _unknown_command(robot: RobotClient) -> str:
    return _refused(robot.command("DANCE"), Code.UNKNOWN)


def _targeting_first(robot: RobotClient) -> str:
    robot.start_up()
    return _refused(robot.command("TARGETING"), Code.NOT_READY)


def _move_first(robot: RobotClient) -> str:
    robot.start_up()
    return _refused(robot.command("MOVE_TO_TARGET"), Code.NOT_READY)


def _move_in_manual(robot: RobotClient) -> str:
    robot.start_up()
    robot.command("MANUAL").refuse_unless_ok()
    seen = _refused(robot.command("MOVE_TO_TARGET"), Code.MANUAL, Code.NOT_READY)
    robot.start_up()
    return seen


def _takes_a_registration(robot: RobotClient) -> str:
    robot.start_up()
    robot.calibrate(REGISTRATION)
    return "CALIBRATION, CLB_"


def _no_registration(matrix: np.ndarray) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        robot.start_up()
        robot.command("CALIBRATION")
        return _refused(robot.send_transform(contract.CALIBRATION, matrix, "CALIBRATION"), Code.CONFIGURATION)

    return question


def _no_target(matrix: np.ndarray, **said: str) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        if said and contract.HAS_PLAN not in robot.capabilities:
            raise _UnsupportedError(f"announces no {contract.HAS_PLAN}")
        robot.start_up()
        robot.calibrate(REGISTRATION)
        robot.command("TARGETING").refuse_unless_ok()
        return _refused(robot.send_transform(contract.TARGET, matrix, "TARGET", said), Code.CONFIGURATION)

    return question


def _in_metres(robot: RobotClient) -> str:
    """Not of the old convention, whose robots cannot tell."""
    if contract.HAS_PLAN not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_PLAN}")
    return _no_target(_at(0.05, 0.02, 0.01))(robot)


def _stops(name: str) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        robot.start_up()
        for phase in ("PLANNING", "CALIBRATION"):
            robot.command(phase).refuse_unless_ok()
            began = monotonic()
            robot.command(name).refuse_unless_ok()
            took = monotonic() - began
            robot.start_up()
        return f"answered in {1e3 * took:.0f} ms"

    return question


def _stops_from_elsewhere(robot: RobotClient) -> str:
    robot.start_up()
    try:
        with RobotClient(robot.host, robot.port, heartbeat=False) as other:
            _need(other.command("STOP").code == Code.OK, "STOP was refused")
    except LinkError as error:
        raise _UnsupportedError(f"takes one client only: {error}") from error
    return "on a second connection"


def _survives(data: bytes, pieces: bool = False) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        stream = Stream()
        with create_connection((robot.host, robot.port), timeout=contract.ACK_S) as raw:
            for piece in [data[k : k + 1] for k in range(len(data))] if pieces else [data]:
                raw.sendall(piece)
            raw.sendall(encode(Message(String("START_UP"), "CMD_8")))
            while came := _received(raw):
                for event in stream.feed(came):
                    if isinstance(event, Message) and event.device_name == "ACK_8":
                        return "answers afterwards"
        raise LinkError("no answer afterwards")

    return question


def _received(raw: socket) -> bytes:
    try:
        return raw.recv(1 << 16)
    except OSError:
        return b""


def _lease(robot: RobotClient) -> str:
    if not robot.capabilities:
        raise _UnsupportedError("the old convention knows no lease")
    robot.start_up()
    with RobotClient(robot.host, robot.port, heartbeat=False) as other:
        return _refused(other.command("START_UP"), Code.DENIED)


def _forgets_a_lost_client(robot: RobotClient) -> str:
    if not robot.capabilities:
        raise _UnsupportedError("the old convention does not say what becomes of a lost client")
    with RobotClient(robot.host, robot.port) as other:
        robot.close()
        end = monotonic() + contract.STATUS_S
        other.start_up()
        other.calibrate(REGISTRATION)
    with RobotClient(robot.host, robot.port) as third:
        while third.status().error_name != "UNDEFINED":
            _need(monotonic() < end, "the phase is still the lost client's")
        return "returns to UNDEFINED"


def _streams(robot: RobotClient) -> str:
    if contract.HAS_TELEMETRY not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_TELEMETRY}")
    rows = robot.stream(contract.MEASURED_JS).body
    if not (isinstance(rows, NDArray) and rows.values.ndim == 2 and len(rows.values) == 6):
        raise RobotRefusedError(f"{contract.MEASURED_JS} is no array (6, N)")
    pose = robot.stream(contract.MEASURED_CP).body
    _need(isinstance(pose, Transform) and pose.fault is None, f"{contract.MEASURED_CP} is no pose")
    return f"{contract.MEASURED_CP}, {contract.MEASURED_JS} of {rows.values.shape[1]} joints"


def _emergency_and_reset(robot: RobotClient) -> str:
    if contract.HAS_RESET not in robot.capabilities or not robot.simulated:
        raise _UnsupportedError("a person would have to reset the robot afterwards; asked of simulators only")
    robot.start_up()
    robot.command("EMERGENCY")
    _need(robot.command("START_UP").code != Code.OK, "START_UP is obeyed in EMERGENCY")
    fault = robot.status().subcode
    try:
        robot.reset(fault + 1)
    except RobotRefusedError:
        robot.reset(fault)
        return f"fault {fault}, left by a reset that names it"
    raise RobotRefusedError("a reset of another fault was obeyed")


def _dry_run(robot: RobotClient) -> str:
    robot.start_up()
    if contract.HAS_TELEMETRY in robot.capabilities:
        T_mcs_wire = _pose(robot.stream(contract.MEASURED_CP))
        hip = T_mcs_wire.apply([0.0, 0.0, HIP_AHEAD_MM])
        robot.calibrate(RigidTransform.from_components(hip, Rotation.from_rotvec([0.0, 0.0, np.pi])))
    else:
        robot.calibrate(REGISTRATION)
    now, why = robot.position(), ""
    for ahead in AHEAD_MM:
        target = now * RigidTransform.from_translation([0.0, ASIDE_MM, ahead])
        try:
            reached = robot.aim(target)
            break
        except RobotRefusedError as error:
            why = why or str(error)
    else:
        raise _UnsupportedError(f"no target ahead of the wire is reachable: {why}")
    robot.align()
    tip = (reached.inv() * robot.position()).translation
    aside = float(np.hypot(*tip[:2]))
    robot.stop().refuse_unless_ok()
    _need(aside < ARRIVED_MM, f"the aligned wire lies {aside:.2f} mm beside its line")
    return f"{aside:.2f} mm beside its line, {-tip[2]:.0f} mm before its end"


def _refused(said: Said, *codes: Code) -> str:
    _need(said.code in codes, f"code {said.code} ({said.text or 'no text'}), wanted {' or '.join(map(str, codes))}")
    return f"code {said.code}: {said.text}" if said.text else f"code {said.code}"


def _need(condition: bool, seen: str) -> None:
    if not condition:
        raise RobotRefusedError(seen)


def _pose(message: Message) -> RigidTransform:
    if not isinstance(message.body, Transform):
        raise RobotRefusedError(f"{message.device_name} is no TRANSFORM")
    return message.body.rigid()


def _at(x: float, y: float, z: float, matrix: Iterable[Iterable[float]] | None = None) -> np.ndarray:
    out = np.eye(4)
    if matrix is not None:
        out[:3, :3] = np.array([list(row) for row in matrix])
    out[:3, 3] = x, y, z
    return out


_SCALED = 2 * np.eye(3)
_GOOD = encode(Message(Status(1), "HELLO"))
_PLAN = {
    contract.PLAN: "conformance", contract.SIDE: "right", contract.FRAME_SERIAL: "none", contract.GO: contract.NO,
    contract.UNITS: contract.MM, contract.COORDINATES: contract.CFCS, contract.LENGTH_MM: "90",
    contract.DEPTH_LIMIT_MM: "91", contract.VALID_S: "60",
}  # fmt: skip

_QUESTIONS: dict[str, Callable[[RobotClient], str]] = {
    "START_UP is answered in time": _starts_up,
    "answers come in their order": _order,
    "phase is told, PLANNING from START_UP": _knows_its_phase,
    "unknown command: 12": _unknown_command,
    "TARGETING without calibration: 13": _targeting_first,
    "MOVE_TO_TARGET without target: 13": _move_first,
    "MOVE_TO_TARGET in MANUAL: 14 or 13": _move_in_manual,
    "takes a registration": _takes_a_registration,
    "registration that is no rotation: 10": _no_registration(_at(500, 0, 0, _SCALED)),
    "registration of NaN: 10": _no_registration(_at(np.nan, 0, 0)),
    "target that is no rotation: 10": _no_target(_at(50, 0, 0, _SCALED)),
    "target of NaN: 10": _no_target(_at(np.nan, 0, 0)),
    "target out of reach: 10": _no_target(_at(5000, 0, 0)),
    "target in metres: 10": _in_metres,
    "plan that is NO-GO: 10": _no_target(_at(50, 20, 10), **_PLAN),
    "plan in another frame: 10": _no_target(_at(50, 20, 10), **(_PLAN | {contract.COORDINATES: "RAS"})),
    "STOP is obeyed in every phase": _stops("STOP"),
    "STOP on a second connection": _stops_from_elsewhere,
    "survives a wrong CRC": _survives(_GOOD[:-1] + bytes([_GOOD[-1] ^ 1])),
    "survives an unknown type": _survives(_GOOD.replace(b"STATUS\0", b"NOVELTY", 1)),
    "survives a message in pieces": _survives(_GOOD, pieces=True),
    "reads header version 2": _survives(encode(Message(Status(1), "HELLO", version=2, metadata={"a": "b"}))),
    "one client holds the lease": _lease,
    "forgets a lost client": _forgets_a_lost_client,
    "streams": _streams,
    "EMERGENCY waits for a reset": _emergency_and_reset,
}
