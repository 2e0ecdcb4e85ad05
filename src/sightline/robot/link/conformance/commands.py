"""Questions about commands: acknowledgement, order of answers, refusals and their codes, repeated commands."""

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import String
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import Question, expect, expect_code, require_identifiers
from sightline.robot.link.conformance.conversation import Conversation, NotAskedError

_NOT_READY = (Code.NOT_READY,)


def _acknowledges(robot: RobotClient) -> str:
    talk = Conversation(robot)
    slowest = 0.0
    for name in ("START_UP", "PLANNING"):
        answer = talk.command(name, whole=True)
        expect(answer.ack_s is not None and answer.ack_s <= contract.ACK_S, f"no ACK of {name} within 1 s")
        expect(answer.status_s is not None, f"no STATUS {name} within {contract.STATUS_S:g} s")
        slowest = max(slowest, answer.ack_s or 0.0)
    return f"in {1e3 * slowest:.0f} ms"


def _repeats_the_command(robot: RobotClient) -> str:
    answer = Conversation(robot).command("START_UP", whole=True)
    if answer.ack is None:
        raise NotAskedError("no ACK came")
    text = answer.ack.body.text if isinstance(answer.ack.body, String) else answer.ack.type_name
    expect(text == "START_UP", f"the ACK of START_UP says {text[:40]!r}")
    return "ACK says what it acknowledges"


def _in_order(robot: RobotClient) -> str:
    answer = Conversation(robot).command("START_UP", whole=True)
    wanted = ["ACK", contract.CURRENT_STATUS, "START_UP"]
    expect(answer.order == wanted, f"came: {', '.join(answer.order) or 'nothing'}; wanted: {', '.join(wanted)}")
    return "ACK, CURRENT_STATUS, STATUS"


def _tells_its_phase(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP")
    status = robot.status()
    expect(status.code == Code.OK, f"CURRENT_STATUS in START_UP has code {status.code}")
    phase = talk.phase()
    expect(phase == "START_UP", f"CURRENT_STATUS in START_UP is a STATUS named {phase!r}")
    return status.text or "STATUS named after the phase"


def _plans_from_start_up(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP")
    return expect_code(talk.command("PLANNING"), Code.OK)


def _unknown_command(robot: RobotClient) -> str:
    answer = Conversation(robot).command("DANCE", whole=True)
    expect(answer.ack is not None, "no ACK of DANCE within 1 s")
    return expect_code(answer, Code.UNKNOWN)


def _refused_after(*before: str, command: str, codes: tuple[Code, ...]) -> Question:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        for phase in before:
            talk.bring(phase)
        try:
            return expect_code(talk.command(command), *codes)
        finally:
            talk.command("STOP")

    return question


def _acts_once(robot: RobotClient) -> str:
    require_identifiers(robot)
    talk, number = Conversation(robot), robot.exchange.next_number()
    first = talk.command("START_UP", number=number)
    talk.at("PLANNING")
    again = talk.command("START_UP", number=number, whole=True)
    expect(again.ack is not None, "the repeated command was not acknowledged")
    expect(again.code == first.code, f"the repeated command was answered by {again.code}, the first by {first.code}")
    phase = talk.phase()
    expect(phase == "PLANNING", f"the repeated START_UP acted again: the phase is {phase}")
    return "the first answer, and nothing else"


def _refuses_a_used_identifier(robot: RobotClient) -> str:
    require_identifiers(robot)
    talk, number = Conversation(robot), robot.exchange.next_number()
    if talk.command("START_UP", number=number).code != Code.OK:
        raise NotAskedError("START_UP was not done")
    before = talk.phase()
    said = expect_code(talk.command("PLANNING", number=number), Code.CONFIGURATION)
    phase = talk.phase()
    expect(phase == before, f"it was obeyed: the phase went from {before} to {phase}")
    return said


QUESTIONS: dict[str, Question] = {
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
}
