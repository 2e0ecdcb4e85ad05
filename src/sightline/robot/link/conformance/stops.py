"""Questions about stops and about several clients."""

from time import monotonic

import numpy as np

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import NDArray
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import (
    Question,
    UnsupportedError,
    expect,
    expect_code,
    require,
    require_several,
    second_client,
)
from sightline.robot.link.conformance.conversation import Conversation
from sightline.robot.link.exchange import pose_of


def _stands_on_stop(robot: RobotClient) -> str:
    talk = Conversation(robot)
    slowest = 0.0
    for phase in ("START_UP", "PLANNING", "CALIBRATION"):
        talk.at("START_UP", phase)
        answer = talk.command("STOP")
        expect_code(answer, Code.OK)
        now = talk.phase()
        expect(now == "STOP", f"after STOP in {phase} the phase is {now}")
        slowest = max(slowest, answer.status_s or 0.0)
    return f"answered in {1e3 * slowest:.0f} ms"


def _stops_from_elsewhere(robot: RobotClient) -> str:
    require_several(robot)
    talk = Conversation(robot)
    talk.at("START_UP")
    with second_client(robot) as other:
        expect_code(Conversation(other).command("STOP"), Code.OK)
    now = talk.phase()
    expect(now == "STOP", f"after STOP on a second connection the phase is {now}")
    return "on a second connection"


def _in_emergency(robot: RobotClient) -> tuple[Conversation, int]:
    """Bring a simulator into EMERGENCY; return the conversation and the fault to reset."""
    _require_simulator(robot)
    talk = Conversation(robot)
    talk.bring("START_UP")
    talk.command("EMERGENCY")
    return talk, robot.status().subcode


def _waits_in_emergency(robot: RobotClient) -> str:
    talk, fault = _in_emergency(robot)
    obeyed = talk.command("START_UP").code == Code.OK
    robot.reset(robot.status().subcode or fault)
    expect(not obeyed, "START_UP is obeyed in EMERGENCY")
    return "START_UP is refused"


def _reset_names_its_fault(robot: RobotClient) -> str:
    _, fault = _in_emergency(robot)
    try:
        robot.reset(fault + 1)
    except RobotRefusedError:
        robot.reset(fault)
        return f"fault {fault}, left by a reset that names it"
    raise RobotRefusedError("a reset of another fault was obeyed")


def _require_simulator(robot: RobotClient) -> None:
    if contract.HAS_RESET not in robot.capabilities or not robot.simulated:
        raise UnsupportedError("a person would have to reset the robot afterwards; asked of simulators only")


STOPS: dict[str, Question] = {
    "STOP is obeyed in every phase": _stands_on_stop,
    "STOP on a second connection": _stops_from_elsewhere,
}
EMERGENCIES: dict[str, Question] = {
    "EMERGENCY waits for a reset": _waits_in_emergency,
    "a reset names its fault": _reset_names_its_fault,
}


def _lease(robot: RobotClient) -> str:
    require_several(robot)
    Conversation(robot).bring("START_UP")
    with second_client(robot) as other:
        return expect_code(Conversation(other).command("START_UP"), Code.DENIED)


def _forgets_a_lost_client(robot: RobotClient) -> str:
    require_several(robot)
    Conversation(robot).at("START_UP")
    robot.close()
    with second_client(robot) as other:
        end = monotonic() + contract.STATUS_S
        while (phase := Conversation(other).phase()) != "UNDEFINED":
            expect(monotonic() < end, f"the phase is still the lost client's, {phase}")
    return "returns to UNDEFINED"


def _streams(robot: RobotClient) -> str:
    require(robot, contract.HAS_TELEMETRY)
    rows = robot.connection.fresh(contract.MEASURED_JS).body
    array = isinstance(rows, NDArray) and rows.values.ndim == 2 and len(rows.values) == 6
    expect(array, f"{contract.MEASURED_JS} is not an array (6, N)")
    assert isinstance(rows, NDArray)  # noqa: S101
    expect(bool(np.isfinite(rows.values).all()), f"{contract.MEASURED_JS} holds numbers that are not finite")
    pose_of(robot.connection.fresh(contract.MEASURED_CP))
    return f"{contract.MEASURED_CP}, {contract.MEASURED_JS} of {rows.values.shape[1]} joints"


CLIENTS: dict[str, Question] = {
    "one client holds the lease": _lease,
    "forgets a lost client": _forgets_a_lost_client,
    "streams": _streams,
}
