"""Questions about messages, commands, stops and several clients."""

from collections.abc import Iterable
from functools import partial
from time import monotonic

import numpy as np

from sightline.errors import LinkError, RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Message, NDArray, String, encode
from sightline.robot.igtl.wire import HEADER_BYTES
from sightline.robot.link.conformance.conversation import (
    IDENTIFIERS,
    SEVERAL,
    Conversation,
    NotAskedError,
    Question,
    UnsupportedError,
    expect,
    expect_code,
    registered,
)
from sightline.robot.link.exchange import pose_of


def _acknowledges(talk: Conversation) -> str:
    slowest = 0.0
    for name in ("START_UP", "PLANNING"):
        answer = talk.command(name, whole=True)
        expect(answer.ack_s is not None and answer.ack_s <= contract.ACK_S, f"no ACK of {name} within 1 s")
        expect(answer.status_s is not None, f"no STATUS {name} within {contract.STATUS_S:g} s")
        slowest = max(slowest, answer.ack_s or 0.0)
    return f"in {1e3 * slowest:.0f} ms"


def _repeats_the_command(talk: Conversation) -> str:
    answer = talk.command("START_UP", whole=True)
    if answer.ack is None:
        raise NotAskedError("no ACK came")
    text = answer.ack.body.text if isinstance(answer.ack.body, String) else answer.ack.type_name
    expect(text == "START_UP", f"the ACK of START_UP says {text[:40]!r}")
    return "ACK says what it acknowledges"


def _in_order(talk: Conversation) -> str:
    answer = talk.command("START_UP", whole=True)
    wanted = ["ACK", contract.CURRENT_STATUS, "START_UP"]
    expect(answer.order == wanted, f"came: {', '.join(answer.order) or 'nothing'}; wanted: {', '.join(wanted)}")
    return "ACK, CURRENT_STATUS, STATUS"


def _tells_its_phase(talk: Conversation) -> str:
    talk.bring("START_UP")
    status = talk.robot.status()
    expect(status.code == Code.OK, f"CURRENT_STATUS in START_UP has code {status.code}")
    phase = talk.phase()
    expect(phase == "START_UP", f"CURRENT_STATUS in START_UP is a STATUS named {phase!r}")
    return status.text or "STATUS named after the phase"


def _plans_from_start_up(talk: Conversation) -> str:
    talk.bring("START_UP")
    return expect_code(talk.command("PLANNING"), Code.OK)


def _unknown_command(talk: Conversation) -> str:
    answer = talk.command("DANCE", whole=True)
    expect(answer.ack is not None, "no ACK of DANCE within 1 s")
    return expect_code(answer, Code.UNKNOWN)


def _no_targeting(talk: Conversation) -> str:
    talk.bring("START_UP")
    return talk.refused("TARGETING", Code.NOT_READY)


def _no_motion_without_target(talk: Conversation) -> str:
    registered(talk)
    talk.bring("TARGETING")
    return talk.refused("MOVE_TO_TARGET", Code.NOT_READY)


def _acts_once(talk: Conversation) -> str:
    talk.require_ours(IDENTIFIERS)
    number = talk.robot.next_number()
    first = talk.command("START_UP", number=number)
    talk.at("PLANNING")
    again = talk.command("START_UP", number=number, whole=True)
    expect(again.ack is not None, "the repeated command was not acknowledged")
    expect(again.code == first.code, f"the repeated command was answered by {again.code}, the first by {first.code}")
    talk.expect_phase("PLANNING", "the repeated START_UP acted again:")
    return "the first answer, and nothing else"


def _refuses_a_used_identifier(talk: Conversation) -> str:
    talk.require_ours(IDENTIFIERS)
    number = talk.robot.next_number()
    if talk.command("START_UP", number=number).code != Code.OK:
        raise NotAskedError("START_UP was not done")
    before = talk.phase()
    text = expect_code(talk.command("PLANNING", number=number), Code.CONFIGURATION)
    talk.expect_phase(before, f"it was obeyed in {before}:")
    return text


def _refuses_a_shot(texts: Iterable[str], talk: Conversation) -> str:
    """Ask whether these depths of a shot are refused. In START_UP all are, so nothing has to move."""
    talk.require(contract.HAS_DRILLING)
    talk.bring("START_UP")
    for text in texts:
        try:
            talk.robot.order(contract.SHOT_DEPTH, text)
        except RobotRefusedError:
            continue
        raise RobotRefusedError(f"{contract.SHOT_DEPTH} of {text!r} was taken in START_UP")
    return "refused"


COMMANDS: dict[str, Question] = {
    "commands are acknowledged in time": _acknowledges,
    "ACK carries the command's text": _repeats_the_command,
    "answers come in their order": _in_order,
    "unknown command: 12": _unknown_command,
    "the phase is told": _tells_its_phase,
    "PLANNING from START_UP": _plans_from_start_up,
    "TARGETING without calibration: 13": _no_targeting,
    "MOVE_TO_TARGET without target: 13": _no_motion_without_target,
    "a repeated command acts once": _acts_once,
    "an identifier used for another command: 10": _refuses_a_used_identifier,
    "SHOT_DEPTH outside PAUSED is refused": partial(_refuses_a_shot, ["30 0.2"]),
    "SHOT_DEPTH of NaN is refused": partial(_refuses_a_shot, ["nan", "nan 0.2", "30 nan", "inf", "30 inf"]),
}


def _obeys_no_wrong_crc(talk: Conversation) -> str:
    talk.at("START_UP")
    for name in ("PLANNING", "CALIBRATION", "MANUAL"):
        talk.robot.connection.send_bytes(_altered(encode(Message(String(name), f"{contract.COMMAND}X{name[:3]}"))))
        try:
            phase = talk.phase()
        except LinkError as error:
            raise NotAskedError(f"it hangs up: {error}") from error
        expect(phase == "START_UP", f"{name} with a wrong CRC was obeyed: the phase is {phase}")
    return "the phase stays"


def _survives(data: bytes, talk: Conversation) -> str:
    talk.bring("START_UP")
    talk.robot.connection.send_bytes(data)
    expect(talk.command("PLANNING").status_s is not None, "no answer afterwards")
    return "answers afterwards"


def _reads(message: bytes, talk: Conversation, piece: int = 1000) -> str:
    """Ask whether START_UP is read in another form, in pieces of `piece` bytes."""
    talk.bring("START_UP", "PLANNING")
    pieces = [message[k : k + piece] for k in range(0, len(message), piece)]
    answer = talk.exchange(lambda: talk.robot.connection.send_bytes(*pieces), "77", "START_UP")
    return expect_code(answer, Code.OK)


def _reads_pieces(message: bytes, talk: Conversation) -> str:
    """Ask the same byte by byte, over a connection without heartbeats between the bytes."""
    if contract.HAS_HEARTBEAT not in talk.robot.capabilities:
        return _reads(message, talk, piece=1)
    talk.robot.close()
    with talk.second() as quiet:
        return _reads(message, quiet, piece=1)


def _altered(data: bytes) -> bytes:
    """Return a message with another CRC: otherwise it is as it should be, so that who ignores the CRC obeys it."""
    return data[: HEADER_BYTES - 1] + bytes([data[HEADER_BYTES - 1] ^ 1]) + data[HEADER_BYTES:]


_STATE = Message(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
_START = Message(String("START_UP"), f"{contract.COMMAND}77")
_START_2 = Message(String("START_UP"), f"{contract.COMMAND}77", version=2, metadata={"a": "b"})


MESSAGES: dict[str, Question] = {
    "a command with a wrong CRC is not obeyed": _obeys_no_wrong_crc,
    "survives a wrong CRC": partial(_survives, _altered(encode(_STATE))),
    "survives an unknown type": partial(_survives, encode(_STATE).replace(b"STRING\0", b"NOVELTY", 1)),
    "reads a message in pieces": partial(_reads_pieces, encode(_START)),
    "reads header version 2": partial(_reads, encode(_START_2)),
}


def _stands_on_stop(talk: Conversation) -> str:
    slowest = 0.0
    for phase in ("START_UP", "PLANNING", "CALIBRATION"):
        talk.at("START_UP", phase)
        answer = talk.command("STOP")
        expect_code(answer, Code.OK)
        talk.expect_phase("STOP", f"after STOP in {phase}")
        slowest = max(slowest, answer.status_s or 0.0)
    return f"answered in {1e3 * slowest:.0f} ms"


def _stops_from_elsewhere(talk: Conversation) -> str:
    talk.require_ours(SEVERAL)
    talk.at("START_UP")
    with talk.second() as other:
        expect_code(other.command("STOP"), Code.OK)
    talk.expect_phase("STOP", "after STOP on a second connection")
    return "on a second connection"


def _in_emergency(talk: Conversation) -> int:
    """Bring a simulator into EMERGENCY; return the fault to reset."""
    if contract.HAS_RESET not in talk.robot.capabilities or not talk.robot.simulated:
        raise UnsupportedError("a person would have to reset the robot afterwards; asked of simulators only")
    talk.bring("START_UP")
    talk.command("EMERGENCY")
    return talk.robot.status().subcode


def _waits_in_emergency(talk: Conversation) -> str:
    fault = _in_emergency(talk)
    obeyed = talk.command("START_UP").code == Code.OK
    talk.robot.reset(talk.robot.status().subcode or fault)
    expect(not obeyed, "START_UP is obeyed in EMERGENCY")
    return "START_UP is refused"


def _reset_names_its_fault(talk: Conversation) -> str:
    fault = _in_emergency(talk)
    try:
        talk.robot.reset(fault + 1)
    except RobotRefusedError:
        talk.robot.reset(fault)
        return f"fault {fault}, left by a reset that names it"
    raise RobotRefusedError("a reset of another fault was obeyed")


STOPS: dict[str, Question] = {
    "STOP is obeyed in every phase": _stands_on_stop,
    "STOP on a second connection": _stops_from_elsewhere,
}
EMERGENCIES: dict[str, Question] = {
    "EMERGENCY waits for a reset": _waits_in_emergency,
    "a reset names its fault": _reset_names_its_fault,
}


def _lease(talk: Conversation) -> str:
    talk.require_ours(SEVERAL)
    talk.bring("START_UP")
    with talk.second() as other:
        return expect_code(other.command("START_UP"), Code.DENIED)


def _forgets_a_lost_client(talk: Conversation) -> str:
    talk.require_ours(SEVERAL)
    talk.at("START_UP")
    talk.robot.close()
    with talk.second() as other:
        end = monotonic() + contract.STATUS_S
        while (phase := other.phase()) != "UNDEFINED":
            expect(monotonic() < end, f"the phase is still the lost client's, {phase}")
    return "returns to UNDEFINED"


def _streams(talk: Conversation) -> str:
    talk.require(contract.HAS_TELEMETRY)
    rows = talk.robot.connection.fresh(contract.MEASURED_JS).body
    array = isinstance(rows, NDArray) and rows.values.ndim == 2 and len(rows.values) == 6
    expect(array, f"{contract.MEASURED_JS} is not an array (6, N)")
    assert isinstance(rows, NDArray)  # noqa: S101
    expect(bool(np.isfinite(rows.values).all()), f"{contract.MEASURED_JS} holds numbers that are not finite")
    pose_of(talk.robot.connection.fresh(contract.MEASURED_CP))
    return f"{contract.MEASURED_CP}, {contract.MEASURED_JS} of {rows.values.shape[1]} joints"


CLIENTS: dict[str, Question] = {
    "one client holds the lease": _lease,
    "forgets a lost client": _forgets_a_lost_client,
    "streams": _streams,
}
