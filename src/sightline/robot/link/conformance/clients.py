"""Questions about clients: command lease, lost clients, and streams."""

from time import monotonic

import numpy as np

from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import NDArray
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import (
    Question,
    expect,
    expect_code,
    require,
    require_several,
    second_client,
)
from sightline.robot.link.conformance.conversation import Conversation
from sightline.robot.link.exchange import pose_of


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


QUESTIONS: dict[str, Question] = {
    "one client holds the lease": _lease,
    "forgets a lost client": _forgets_a_lost_client,
    "streams": _streams,
}
