"""Questions about the OpenIGTLink protocol: CRC, unknown types, fragmented messages, header version 2."""

from sightline.errors import LinkError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Message, String, encode
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import Question, expect, expect_code, second_client
from sightline.robot.link.conformance.conversation import Conversation, NotAskedError


def _obeys_no_wrong_crc(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.at("START_UP")
    for name in ("PLANNING", "CALIBRATION", "MANUAL"):
        robot.connection.send_bytes(_altered(encode(Message(String(name), f"{contract.COMMAND}X{name[:3]}"))))
        try:
            phase = talk.phase()
        except LinkError as error:
            raise NotAskedError(f"it hangs up: {error}") from error
        expect(phase == "START_UP", f"{name} with a wrong CRC was obeyed: the phase is {phase}")
    return "the phase stays"


def _survives(data: bytes) -> Question:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP")
        robot.connection.send_bytes(data)
        expect(talk.command("PLANNING").status_s is not None, "no answer afterwards")
        return "answers afterwards"

    return question


def _reads(message: bytes, piece: int = 1000) -> Question:
    """Return the question whether START_UP is read in another form, in pieces of `piece` bytes."""

    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP", "PLANNING")
        pieces = [message[k : k + piece] for k in range(0, len(message), piece)]
        answer = talk.exchange(lambda: robot.connection.send_bytes(*pieces), "77", "START_UP")
        return expect_code(answer, Code.OK)

    return question


def _reads_pieces(message: bytes) -> Question:
    """Return the same question byte by byte, over a connection without heartbeats between the bytes."""
    reads = _reads(message, piece=1)

    def question(robot: RobotClient) -> str:
        if contract.HAS_HEARTBEAT not in robot.capabilities:
            return reads(robot)
        robot.close()
        with second_client(robot) as quiet:
            return reads(quiet)

    return question


def _altered(data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 1])


_STATE = Message(String(contract.CURRENT_STATUS), contract.CURRENT_STATUS)
_START = Message(String("START_UP"), f"{contract.COMMAND}77")
_START_2 = Message(String("START_UP"), f"{contract.COMMAND}77", version=2, metadata={"a": "b"})


QUESTIONS: dict[str, Question] = {
    "a command with a wrong CRC is not obeyed": _obeys_no_wrong_crc,
    "survives a wrong CRC": _survives(_altered(encode(_STATE))),
    "survives an unknown type": _survives(encode(_STATE).replace(b"STRING\0", b"NOVELTY", 1)),
    "reads a message in pieces": _reads_pieces(encode(_START)),
    "reads header version 2": _reads(encode(_START_2)),
}
