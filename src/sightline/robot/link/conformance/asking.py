"""Helpers of the questions: required capabilities, a target in air, and expectations on responses."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Transform
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.conversation import Conversation, NotAskedError, Response
from sightline.robot.link.exchange import pose_of
from sightline.robot.link.wire_deviation import WireDeviation, refuse_other_pose

# A registration for tests of refusals, where any will do: 500 mm from base to hip, as many robots stand.
REGISTRATION = RigidTransform.from_translation([500.0, 0.0, 0.0])
# Target in air: distances ahead of the wire, mm, of which the first reachable one is used, and the distance aside.
AHEAD_MM, ASIDE_MM = (130.0, 100.0, 60.0, 30.0), 3.0
HIP_AHEAD_MM = 150.0  # ahead of the wire in its sleeve, as our frame is held; CFCS upright, its +X towards the robot
Question = Callable[[RobotClient], str]  # returns what was observed; raises if it breaks the contract


class UnsupportedError(Exception):
    """The robot does not announce the capability that a question needs."""


def require(robot: RobotClient, capability: str, why: str = "") -> None:
    """Raise UnsupportedError unless the robot announces a capability; `why`: the reason it is needed."""
    if capability not in robot.capabilities:
        raise UnsupportedError(f"announces no {capability}" + (f": {why}" if why else ""))


def require_several(robot: RobotClient) -> None:
    """Raise UnsupportedError unless the robot accepts several clients."""
    if not robot.capabilities:
        raise UnsupportedError("a robot of the 2013 convention accepts one client")


def require_identifiers(robot: RobotClient) -> None:
    """Raise UnsupportedError unless the robot's convention defines repeated identifiers."""
    if not robot.capabilities:
        raise UnsupportedError("the 2013 convention does not define repeated identifiers")


def second_client(robot: RobotClient) -> RobotClient:
    """Return a second connection to the robot, without heartbeats."""
    return RobotClient(robot.host, robot.port, heartbeat=False)


def target_in_air(robot: RobotClient, talk: Conversation) -> np.ndarray:
    """Send a target ahead of the wire that the robot accepts, and return it, (4, 4) CFCS. Raises NotAskedError."""
    talk.bring("START_UP")
    registration = REGISTRATION
    if contract.HAS_TELEMETRY in robot.capabilities:
        T_mcs_wire = pose_of(robot.connection.fresh(contract.MEASURED_CP))
        hip = T_mcs_wire.apply([0.0, 0.0, HIP_AHEAD_MM])
        registration = RigidTransform.from_components(hip, Rotation.from_rotvec([0.0, 0.0, np.pi]))
    talk.bring("CALIBRATION")
    answer = talk.pose(contract.CALIBRATION, registration.inv().as_matrix())
    if answer.code != Code.OK:
        raise NotAskedError(f"no registration was accepted: {answer.text or answer.code}")
    now, why = robot.position(), ""
    talk.bring("TARGETING")
    for ahead in AHEAD_MM:
        target = (now * RigidTransform.from_translation([0.0, ASIDE_MM, ahead])).as_matrix()
        answer = talk.pose(contract.TARGET, target)
        if answer.code == Code.OK:
            return target
        why = why or answer.text
    raise NotAskedError(f"no target ahead of the wire is reachable: {why or 'no reason given'}")


def verified_target(robot: RobotClient, talk: Conversation) -> np.ndarray:
    """Send a target that the robot accepts and will reach, and return it, (4, 4) CFCS. Raises NotAskedError."""
    target = target_in_air(robot, talk)
    reachable = talk.next("REACHABLE_TARGET", contract.ACK_S)
    if reachable is not None:
        try:
            WireDeviation.of(pose_of(reachable), RigidTransform.from_matrix(target)).refuse_large(
                "it would lay the wire"
            )
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
    return target


def expect(condition: bool, seen: str) -> None:
    """Raise RobotRefusedError with the text `seen` if a condition does not hold."""
    if not condition:
        raise RobotRefusedError(seen)


def expect_code(answer: Response, *codes: Code) -> str:
    """Return the response's code and text. Raises RobotRefusedError for any other code, and if none came."""
    expect(answer.code is not None, "no STATUS came")
    received = f"code {answer.code}: {answer.text}" if answer.text else f"code {answer.code}"
    expect(answer.code in codes, f"{received}; wanted {' or '.join(str(int(code)) for code in codes)}")
    return received


def expect_echo(answer: Response, sent: np.ndarray, what: str) -> str:
    """Expect the matrix `sent` (4, 4) back. Raises RobotRefusedError if none or another came."""
    if answer.ack is None or not isinstance(answer.ack.body, Transform):
        raise RobotRefusedError(f"no echo of the {what} came")
    refuse_other_pose(answer.ack.body.matrix, sent, what)
    return "as it was sent"
