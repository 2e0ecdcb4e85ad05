"""Does a robot keep the contract of docs/robot-link.md? Asked over the link, of any robot; the answer is a table.

Nothing moves but in the dry run, which aligns in air and drills nothing. A question judges one thing: what leads to it
is taken as it comes, and where it does not lead there the question is not asked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from time import monotonic

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.closing import Closing
from sightline.errors import LinkError, RobotRefusedError, SightlineError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Fault, Message, NDArray, Rejected, String, Transform, encode
from sightline.robot.link.client import RobotClient, pose_of
from sightline.robot.link.conformance.conversation import Answer, Conversation, NotAskedError
from sightline.robot.link.laid import Laid, refuse_other_pose

# Any registration does for refusals: 500 mm from base to hip, as many robots stand.
REGISTRATION = RigidTransform.from_translation([500.0, 0.0, 0.0])
# How far beyond where the wire is now a target in air lies, along it, mm: the first that is reachable is taken.
AHEAD_MM, ASIDE_MM = (130.0, 100.0, 60.0, 30.0), 3.0
HIP_AHEAD_MM = 150.0  # of the wire in its sleeve, as our frame is held; CFCS upright, its +X towards the robot
# A robot that notices silence stands by then. More than the contract's 0.2 s: a checking computer that is busy sees it
# late; the time is told [ours].
SILENT_S = 1.5
LOST_S = 0.5  # a connection that ends is seen at once; a motion that ends by itself must not be taken for it [ours]
ALIGN_S = 120.0  # for what a person stands beside [ours]


class Verdict(Enum):
    """Of one question."""

    PASSED = "pass"
    FAILED = "FAIL"
    UNSUPPORTED = "not supported"
    NOT_ASKED = "not asked"


@dataclass(frozen=True)
class Finding:
    """One question, its answer, and what was seen."""

    name: str
    verdict: Verdict
    seen: str


class _UnsupportedError(Exception):
    pass


class Examination(Closing):
    """A robot's examination, over one connection; robots that take several, by their CAPABILITY, are asked over a
    second one too. Raises LinkError where nobody listens."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._unreadable: list[Rejected] = []
        self._robot: RobotClient | None = RobotClient(host, port)
        self.simulated = self._robot.simulated

    def close(self) -> None:
        """End it."""
        if self._robot is not None:
            self._robot.close()
            self._robot = None

    def examine(self) -> list[Finding]:
        """All questions that move nothing."""
        found = [self._ask(name, question) for name, question in QUESTIONS.items()]
        return [*found, self._read_all()]

    def dry_run(self) -> list[Finding]:
        """Motions to a target in air ahead of the wire, most of them stopped; nothing is drilled. On robots of the old
        convention a MOVE_TO_TARGET may insert: the caller must have a person's word that nobody is in the way."""
        return [self._ask(name, question) for name, question in MOTIONS.items()]

    def _ask(self, name: str, question: Callable[[RobotClient], str]) -> Finding:
        try:
            robot = self._connected()
            said = Finding(name, Verdict.PASSED, question(robot))
        except _UnsupportedError as why:
            return Finding(name, Verdict.UNSUPPORTED, str(why))
        except NotAskedError as why:
            said = Finding(name, Verdict.NOT_ASKED, str(why))
        except SightlineError as error:
            said = Finding(name, Verdict.FAILED, str(error))
        if self._robot is not None:
            self._unreadable += self._robot.talk.unreadable
            self._robot.talk.unreadable.clear()
            if self._robot.talk.closed:
                self.close()
        return said

    def _connected(self) -> RobotClient:
        if self._robot is None:
            self._robot = RobotClient(self._host, self._port)
        return self._robot

    def _read_all(self) -> Finding:
        name = "every message can be read"
        # What is fatal has failed its question already; other types are the robot's own affair.
        bad = [e.reason for e in self._unreadable if not e.fatal and e.fault is not Fault.UNKNOWN_TYPE]
        if bad:
            return Finding(name, Verdict.FAILED, f"{len(bad)} could not, the first: {bad[0]}")
        return Finding(name, Verdict.PASSED, "CRC and content of all that came")


# Each returns what was seen, or raises.


def _acknowledges(robot: RobotClient) -> str:
    talk = Conversation(robot)
    slowest = 0.0
    for name in ("START_UP", "PLANNING"):
        answer = talk.command(name, whole=True)
        _need(answer.ack_s is not None and answer.ack_s <= contract.ACK_S, f"no ACK of {name} within 1 s")
        _need(answer.status_s is not None, f"no STATUS {name} within {contract.STATUS_S:g} s")
        slowest = max(slowest, answer.ack_s or 0.0)
    return f"in {1e3 * slowest:.0f} ms"


def _repeats_the_command(robot: RobotClient) -> str:
    answer = Conversation(robot).command("START_UP", whole=True)
    if answer.ack is None:
        raise NotAskedError("no ACK came")
    text = answer.ack.body.text if isinstance(answer.ack.body, String) else answer.ack.type_name
    _need(text == "START_UP", f"the ACK of START_UP says {text[:40]!r}")
    return "ACK says what it acknowledges"


def _in_order(robot: RobotClient) -> str:
    answer = Conversation(robot).command("START_UP", whole=True)
    wanted = ["ACK", contract.CURRENT_STATUS, "START_UP"]
    _need(answer.order == wanted, f"came: {', '.join(answer.order) or 'nothing'}; wanted: {', '.join(wanted)}")
    return "ACK, CURRENT_STATUS, STATUS"


def _tells_its_phase(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP")
    status = robot.status()
    _need(status.code == Code.OK, f"CURRENT_STATUS in START_UP has code {status.code}")
    phase = talk.phase()
    _need(phase == "START_UP", f"CURRENT_STATUS in START_UP is a STATUS named {phase!r}")
    return status.text or "STATUS named after the phase"


def _plans_from_start_up(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP")
    return _code(talk.command("PLANNING"), Code.OK)


def _unknown_command(robot: RobotClient) -> str:
    answer = Conversation(robot).command("DANCE", whole=True)
    _need(answer.ack is not None, "no ACK of DANCE within 1 s")
    return _code(answer, Code.UNKNOWN)


def _refused_after(*before: str, command: str, codes: tuple[Code, ...]) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        for phase in before:
            talk.bring(phase)
        try:
            return _code(talk.command(command), *codes)
        finally:
            talk.command("STOP")

    return question


def _acts_once(robot: RobotClient) -> str:
    _identifies(robot)
    talk, number = Conversation(robot), robot.next_number()
    first = talk.command("START_UP", number=number)
    talk.at("PLANNING")
    again = talk.command("START_UP", number=number, whole=True)
    _need(again.ack is not None, "the repeated command was not acknowledged")
    _need(again.code == first.code, f"the repeated command was answered by {again.code}, the first by {first.code}")
    phase = talk.phase()
    _need(phase == "PLANNING", f"the repeated START_UP acted again: the phase is {phase}")
    return "the first answer, and nothing else"


def _refuses_a_used_identifier(robot: RobotClient) -> str:
    _identifies(robot)
    talk, number = Conversation(robot), robot.next_number()
    if talk.command("START_UP", number=number).code != Code.OK:
        raise NotAskedError("START_UP was not done")
    before = talk.phase()
    said = _code(talk.command("PLANNING", number=number), Code.CONFIGURATION)
    phase = talk.phase()
    _need(phase == before, f"it was obeyed: the phase went from {before} to {phase}")
    return said


def _takes_a_registration(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP", "CALIBRATION")
    return _code(talk.pose(contract.CALIBRATION, REGISTRATION.as_matrix()), Code.OK)


def _echoes_a_registration(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP", "CALIBRATION")
    sent = RigidTransform.from_components([512.5, -0.3, 3.7], Rotation.from_rotvec([0.1, -0.2, 0.3])).as_matrix()
    return _echo(talk.pose(contract.CALIBRATION, sent), sent, "registration")


def _no_registration(matrix: np.ndarray) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP", "CALIBRATION")
        return _code(talk.pose(contract.CALIBRATION, matrix), Code.CONFIGURATION)

    return question


def _no_target(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[RobotClient], str]:
    """A target that is wrong in one thing: without it, it was taken."""

    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        good = _target_in_air(robot, talk)
        talk.bring("TARGETING")
        return _code(talk.pose(contract.TARGET, change(good)), Code.CONFIGURATION)

    return question


def _no_plan(**said: str) -> Callable[[RobotClient], str]:
    """Metadata that must be refused, of a pose that was taken without."""

    def question(robot: RobotClient) -> str:
        if contract.HAS_PLAN not in robot.capabilities:
            raise _UnsupportedError(f"announces no {contract.HAS_PLAN}")
        talk = Conversation(robot)
        good = _target_in_air(robot, talk)
        talk.bring("TARGETING")
        return _code(talk.pose(contract.TARGET, good, said), Code.CONFIGURATION)

    return question


def _in_metres(robot: RobotClient) -> str:
    """Not of the old convention, whose robots cannot tell."""
    if contract.HAS_PLAN not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_PLAN}")
    return _no_target(lambda good: _moved(good, 1e-3 * good[:3, 3]))(robot)


def _echoes_a_target(robot: RobotClient) -> str:
    talk = Conversation(robot)
    good = _target_in_air(robot, talk)
    talk.bring("TARGETING")
    return _echo(talk.pose(contract.TARGET, good), good, "target")


def _reaches_what_it_takes(robot: RobotClient) -> str:
    talk = Conversation(robot)
    good = _target_in_air(robot, talk)
    talk.bring("TARGETING")
    answer = talk.pose(contract.TARGET, good)
    if answer.code != Code.OK:
        raise NotAskedError(f"the target was refused: {answer.text}")
    reachable = talk.next("REACHABLE_TARGET", contract.ACK_S)
    if reachable is None and not robot.capabilities:
        raise _UnsupportedError("of the old convention, it does not say what it reaches")
    if reachable is None:
        raise RobotRefusedError("a target was taken, and no REACHABLE_TARGET came")
    laid = Laid.of(pose_of(reachable), RigidTransform.from_matrix(good))
    laid.refuse_elsewhere("the robot would lay the wire")
    return f"{laid.aside_mm:.2f} mm beside its line"


def _stands_on_stop(robot: RobotClient) -> str:
    talk = Conversation(robot)
    slowest = 0.0
    for phase in ("START_UP", "PLANNING", "CALIBRATION"):
        talk.at("START_UP", phase)
        answer = talk.command("STOP")
        _code(answer, Code.OK)
        now = talk.phase()
        _need(now == "STOP", f"after STOP in {phase} the phase is {now}")
        slowest = max(slowest, answer.status_s or 0.0)
    return f"answered in {1e3 * slowest:.0f} ms"


def _stops_from_elsewhere(robot: RobotClient) -> str:
    _several(robot)
    talk = Conversation(robot)
    talk.at("START_UP")
    with _second(robot) as other:
        _code(Conversation(other).command("STOP"), Code.OK)
    now = talk.phase()
    _need(now == "STOP", f"after STOP on a second connection the phase is {now}")
    return "on a second connection"


def _obeys_no_wrong_crc(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.at("START_UP")
    for name in ("PLANNING", "CALIBRATION", "MANUAL"):
        robot.talk.send_bytes(_altered(encode(Message(String(name), f"{contract.COMMAND}X{name[:3]}"))))
        try:
            phase = talk.phase()
        except LinkError as error:
            raise NotAskedError(f"it hangs up: {error}") from error
        _need(phase == "START_UP", f"{name} with a wrong CRC was obeyed: the phase is {phase}")
    return "the phase stays"


def _survives(data: bytes) -> Callable[[RobotClient], str]:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP")
        robot.talk.send_bytes(data)
        _need(talk.command("PLANNING").status_s is not None, "no answer afterwards")
        return "answers afterwards"

    return question


def _reads(message: bytes, piece: int = 1000) -> Callable[[RobotClient], str]:
    """START_UP, in another form, in pieces of so many bytes."""

    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP", "PLANNING")
        pieces = [message[k : k + piece] for k in range(0, len(message), piece)]
        answer = talk.exchange(lambda: robot.talk.send_bytes(*pieces), "77", "START_UP")
        return _code(answer, Code.OK)

    return question


def _reads_pieces(message: bytes) -> Callable[[RobotClient], str]:
    """The same byte by byte, over a connection on which no heartbeat comes between two of them."""
    reads = _reads(message, piece=1)

    def question(robot: RobotClient) -> str:
        if contract.HAS_HEARTBEAT not in robot.capabilities:
            return reads(robot)
        robot.close()
        with _second(robot) as quiet:
            return reads(quiet)

    return question


def _lease(robot: RobotClient) -> str:
    _several(robot)
    Conversation(robot).bring("START_UP")
    with _second(robot) as other:
        return _code(Conversation(other).command("START_UP"), Code.DENIED)


def _forgets_a_lost_client(robot: RobotClient) -> str:
    _several(robot)
    Conversation(robot).at("START_UP")
    robot.close()
    with _second(robot) as other:
        end = monotonic() + contract.STATUS_S
        while (phase := Conversation(other).phase()) != "UNDEFINED":
            _need(monotonic() < end, f"the phase is still the lost client's, {phase}")
    return "returns to UNDEFINED"


def _streams(robot: RobotClient) -> str:
    if contract.HAS_TELEMETRY not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_TELEMETRY}")
    rows = robot.talk.fresh(contract.MEASURED_JS).body
    array = isinstance(rows, NDArray) and rows.values.ndim == 2 and len(rows.values) == 6
    _need(array, f"{contract.MEASURED_JS} is not an array (6, N)")
    assert isinstance(rows, NDArray)  # noqa: S101
    _need(bool(np.isfinite(rows.values).all()), f"{contract.MEASURED_JS} holds numbers that are not finite")
    pose_of(robot.talk.fresh(contract.MEASURED_CP))
    return f"{contract.MEASURED_CP}, {contract.MEASURED_JS} of {rows.values.shape[1]} joints"


def _in_emergency(robot: RobotClient) -> tuple[Conversation, int]:
    """A simulator, brought there, and the fault to reset."""
    _simulator(robot)
    talk = Conversation(robot)
    talk.bring("START_UP")
    talk.command("EMERGENCY")
    return talk, robot.status().subcode


def _waits_in_emergency(robot: RobotClient) -> str:
    talk, fault = _in_emergency(robot)
    obeyed = talk.command("START_UP").code == Code.OK
    robot.reset(robot.status().subcode or fault)
    _need(not obeyed, "START_UP is obeyed in EMERGENCY")
    return "START_UP is refused"


def _reset_names_its_fault(robot: RobotClient) -> str:
    _, fault = _in_emergency(robot)
    try:
        robot.reset(fault + 1)
    except RobotRefusedError:
        robot.reset(fault)
        return f"fault {fault}, left by a reset that names it"
    raise RobotRefusedError("a reset of another fault was obeyed")


# The dry run.


def _stops_while_moving(robot: RobotClient) -> str:
    talk = Conversation(robot)
    _aimed(robot, talk)
    with talk.moving() as moving:
        return moving.must_stand_after(lambda: talk.command("STOP"))


def _stops_while_moving_from_elsewhere(robot: RobotClient) -> str:
    _several(robot)
    talk = Conversation(robot)
    _aimed(robot, talk)
    with _second(robot) as other, talk.moving() as moving:
        return moving.must_stand_after(lambda: Conversation(other).command("STOP"))


def _moves_once(robot: RobotClient) -> str:
    _identifies(robot)
    talk, number = Conversation(robot), robot.next_number()
    _aimed(robot, talk)
    with talk.moving(number) as moving:
        try:
            moving.must_stand_after(lambda: talk.command("STOP"))
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
        try:
            return moving.must_not_begin_again(talk.command("MOVE_TO_TARGET", number=number, within_s=contract.ACK_S))
        finally:
            talk.command("STOP")


def _notices_silence(robot: RobotClient) -> str:
    if contract.HAS_HEARTBEAT not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_HEARTBEAT}")
    if contract.HAS_TELEMETRY not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_TELEMETRY}: it cannot be watched in silence")
    talk = Conversation(robot)
    _aimed(robot, talk)
    with talk.moving() as moving:
        robot.talk.fall_silent()
        try:
            return moving.must_stand_by_itself(SILENT_S)
        finally:
            talk.command("STOP")
            robot.close()  # the next question has its heartbeats again


def _stops_for_a_lost_client(robot: RobotClient) -> str:
    _several(robot)
    if contract.HAS_TELEMETRY not in robot.capabilities:
        raise _UnsupportedError(f"announces no {contract.HAS_TELEMETRY}: it cannot be watched by another")
    talk = Conversation(robot)
    _aimed(robot, talk)
    with _second(robot) as other, talk.moving() as moving:
        robot.close()
        moving.watch = Conversation(other)
        try:
            return moving.must_stand_by_itself(LOST_S)
        finally:
            Conversation(other).command("STOP")


def _aligns(robot: RobotClient) -> str:
    talk = Conversation(robot)
    target = _aimed(robot, talk)
    _code(talk.command("MOVE_TO_TARGET", within_s=ALIGN_S), Code.OK)
    laid = Laid.of(robot.position(), RigidTransform.from_matrix(target))
    talk.command("STOP")
    Laid(laid.aside_mm, 0.0, laid.angle_rad).refuse_elsewhere("the aligned wire lies")
    return f"{laid.aside_mm:.2f} mm beside its line, {-laid.along_mm:.0f} mm before its end"


# What they share.


def _target_in_air(robot: RobotClient, talk: Conversation) -> np.ndarray:
    """(4, 4): a target ahead of the wire that the robot takes, CFCS; it holds it now. Raises NotAskedError."""
    talk.bring("START_UP")
    registration = REGISTRATION
    if contract.HAS_TELEMETRY in robot.capabilities:
        T_mcs_wire = pose_of(robot.talk.fresh(contract.MEASURED_CP))
        hip = T_mcs_wire.apply([0.0, 0.0, HIP_AHEAD_MM])
        registration = RigidTransform.from_components(hip, Rotation.from_rotvec([0.0, 0.0, np.pi]))
    talk.bring("CALIBRATION")
    said = talk.pose(contract.CALIBRATION, registration.inv().as_matrix())
    if said.code != Code.OK:
        raise NotAskedError(f"no registration was taken: {said.text or said.code}")
    now, why = robot.position(), ""
    talk.bring("TARGETING")
    for ahead in AHEAD_MM:
        target = (now * RigidTransform.from_translation([0.0, ASIDE_MM, ahead])).as_matrix()
        said = talk.pose(contract.TARGET, target)
        if said.code == Code.OK:
            return target
        why = why or said.text
    raise NotAskedError(f"no target ahead of the wire is reachable: {why or 'no reason given'}")


def _aimed(robot: RobotClient, talk: Conversation) -> np.ndarray:
    """(4, 4): a target that the robot has taken, and means. Raises NotAskedError."""
    target = _target_in_air(robot, talk)
    reachable = talk.next("REACHABLE_TARGET", contract.ACK_S)
    if reachable is not None:
        try:
            Laid.of(pose_of(reachable), RigidTransform.from_matrix(target)).refuse_elsewhere("it would lay the wire")
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
    return target


def _second(robot: RobotClient) -> RobotClient:
    return RobotClient(robot.host, robot.port, heartbeat=False)


def _several(robot: RobotClient) -> None:
    if not robot.capabilities:
        raise _UnsupportedError("of the old convention, it takes one client")


def _identifies(robot: RobotClient) -> None:
    if not robot.capabilities:
        raise _UnsupportedError("the old convention does not say what a repeated identifier means")


def _simulator(robot: RobotClient) -> None:
    if contract.HAS_RESET not in robot.capabilities or not robot.simulated:
        raise _UnsupportedError("a person would have to reset the robot afterwards; asked of simulators only")


def _code(answer: Answer, *codes: Code) -> str:
    _need(answer.code is not None, "no STATUS came")
    said = f"code {answer.code}: {answer.text}" if answer.text else f"code {answer.code}"
    _need(answer.code in codes, f"{said}; wanted {' or '.join(str(int(code)) for code in codes)}")
    return said


def _echo(answer: Answer, sent: np.ndarray, what: str) -> str:
    if answer.ack is None or not isinstance(answer.ack.body, Transform):
        raise RobotRefusedError(f"no echo of the {what} came")
    refuse_other_pose(answer.ack.body.matrix, sent, what)
    return "as it was sent"


def _need(condition: bool, seen: str) -> None:
    if not condition:
        raise RobotRefusedError(seen)


def _altered(data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 1])


def _moved(pose: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, 3] = to_mm
    return out


def _scaled(pose: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, :3] *= 2.0
    return out


def _without(*keys: str) -> dict[str, str]:
    return {key: value for key, value in _PLAN.items() if key not in keys}


_STATE = Message(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
_START = Message(String("START_UP"), f"{contract.COMMAND}77")
_START_2 = Message(String("START_UP"), f"{contract.COMMAND}77", version=2, metadata={"a": "b"})
_GENERAL = _moved(np.eye(4), np.array([500.0, 0.0, 0.0]))
_NAN = np.full(3, np.nan)
_PLAN = {
    contract.PLAN: "conformance", contract.SIDE: "right", contract.FRAME_SERIAL: "none", contract.GO: contract.NO,
    contract.UNITS: contract.MM, contract.COORDINATES: contract.CFCS, contract.LENGTH_MM: "90",
    contract.DEPTH_LIMIT_MM: "91", contract.VALID_S: "60",
}  # fmt: skip
_NOT_READY = (Code.NOT_READY,)

QUESTIONS: dict[str, Callable[[RobotClient], str]] = {
    "commands are acknowledged in time": _acknowledges,
    "ACK carries the command's text": _repeats_the_command,
    "answers come in their order": _in_order,
    "unknown command: 12": _unknown_command,
    "the phase is told": _tells_its_phase,
    "PLANNING from START_UP": _plans_from_start_up,
    "TARGETING without calibration: 13": _refused_after("START_UP", command="TARGETING", codes=_NOT_READY),
    "MOVE_TO_TARGET without target: 13": _refused_after("START_UP", command="MOVE_TO_TARGET", codes=_NOT_READY),
    "MOVE_TO_TARGET in MANUAL: 14 or 13": _refused_after(
        "START_UP", "MANUAL", command="MOVE_TO_TARGET", codes=(Code.MANUAL, Code.NOT_READY)
    ),
    "a repeated command acts once": _acts_once,
    "an identifier used for another command: 10": _refuses_a_used_identifier,
    "takes a registration": _takes_a_registration,
    "ACK echoes a registration": _echoes_a_registration,
    "registration that is no rotation: 10": _no_registration(_scaled(_GENERAL)),
    "registration of NaN: 10": _no_registration(_moved(_GENERAL, _NAN)),
    "ACK echoes a target": _echoes_a_target,
    "REACHABLE_TARGET is the target": _reaches_what_it_takes,
    "target that is no rotation: 10": _no_target(_scaled),
    "target of NaN: 10": _no_target(lambda good: _moved(good, _NAN)),
    "target out of reach: 10": _no_target(lambda good: _moved(good, good[:3, 3] + 5000.0)),
    "target in metres: 10": _in_metres,
    "target in another frame: 10": _no_plan(coordinates="RAS"),
    "target in another unit: 10": _no_plan(units="m"),
    "plan that is NO-GO: 10": _no_plan(**_PLAN),
    "plan that leaves out its side: 10": _no_plan(**(_without(contract.SIDE) | {contract.GO: contract.YES})),
    "STOP is obeyed in every phase": _stands_on_stop,
    "STOP on a second connection": _stops_from_elsewhere,
    "a command with a wrong CRC is not obeyed": _obeys_no_wrong_crc,
    "survives a wrong CRC": _survives(_altered(encode(_STATE))),
    "survives an unknown type": _survives(encode(_STATE).replace(b"STRING\0", b"NOVELTY", 1)),
    "reads a message in pieces": _reads_pieces(encode(_START)),
    "reads header version 2": _reads(encode(_START_2)),
    "one client holds the lease": _lease,
    "forgets a lost client": _forgets_a_lost_client,
    "streams": _streams,
    "EMERGENCY waits for a reset": _waits_in_emergency,
    "a reset names its fault": _reset_names_its_fault,
}
MOTIONS: dict[str, Callable[[RobotClient], str]] = {
    "dry run: STOP while moving": _stops_while_moving,
    "dry run: STOP while moving, on a second connection": _stops_while_moving_from_elsewhere,
    "dry run: a repeated command moves nothing": _moves_once,
    "dry run: silence stops motion": _notices_silence,
    "dry run: a lost client's motion stops": _stops_for_a_lost_client,
    "dry run: aligns, and stands": _aligns,
}
