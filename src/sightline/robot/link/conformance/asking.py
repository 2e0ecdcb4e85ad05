"""What the questions share: what a robot must announce to be asked, a target in air, and how answers are judged."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.igtl import Transform
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.conversation import Answer, Conversation, NotAskedError
from sightline.robot.link.exchange import pose_of
from sightline.robot.link.laid import Laid, refuse_other_pose

# Any registration does for refusals: 500 mm from base to hip, as many robots stand.
REGISTRATION = RigidTransform.from_translation([500.0, 0.0, 0.0])
# How far beyond where the wire is now a target in air lies, along it, mm: the first that is reachable is taken.
AHEAD_MM, ASIDE_MM = (130.0, 100.0, 60.0, 30.0), 3.0
HIP_AHEAD_MM = 150.0  # of the wire in its sleeve, as our frame is held; CFCS upright, its +X towards the robot
Question = Callable[[RobotClient], str]  # what was seen; raises where it is not as it should be


class UnsupportedError(Exception):
    """The robot does not claim to do what is asked."""


def require(robot: RobotClient, capability: str, why: str = "") -> None:
    """Raise UnsupportedError unless the robot announces a capability; `why` it is needed."""
    if capability not in robot.capabilities:
        raise UnsupportedError(f"announces no {capability}" + (f": {why}" if why else ""))


def require_several(robot: RobotClient) -> None:
    """Raise UnsupportedError unless the robot takes several clients."""
    if not robot.capabilities:
        raise UnsupportedError("of the old convention, it takes one client")


def require_identifiers(robot: RobotClient) -> None:
    """Raise UnsupportedError unless an identifier that comes again has a meaning."""
    if not robot.capabilities:
        raise UnsupportedError("the old convention does not say what a repeated identifier means")


def second_client(robot: RobotClient) -> RobotClient:
    """A connection beside the one that is asked over, without heartbeats."""
    return RobotClient(robot.host, robot.port, heartbeat=False)


def target_in_air(robot: RobotClient, talk: Conversation) -> np.ndarray:
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


def aimed(robot: RobotClient, talk: Conversation) -> np.ndarray:
    """(4, 4): a target that the robot has taken, and means. Raises NotAskedError."""
    target = target_in_air(robot, talk)
    reachable = talk.next("REACHABLE_TARGET", contract.ACK_S)
    if reachable is not None:
        try:
            Laid.of(pose_of(reachable), RigidTransform.from_matrix(target)).refuse_elsewhere("it would lay the wire")
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
    return target


def expect(condition: bool, seen: str) -> None:
    """Raise RobotRefusedError with what was `seen` where a condition does not hold."""
    if not condition:
        raise RobotRefusedError(seen)


def expect_code(answer: Answer, *codes: Code) -> str:
    """The answer's code and text. Raises RobotRefusedError for any other code, and where none came."""
    expect(answer.code is not None, "no STATUS came")
    said = f"code {answer.code}: {answer.text}" if answer.text else f"code {answer.code}"
    expect(answer.code in codes, f"{said}; wanted {' or '.join(str(int(code)) for code in codes)}")
    return said


def expect_echo(answer: Answer, sent: np.ndarray, what: str) -> str:
    """That the matrix `sent` (4, 4) came back. Raises RobotRefusedError where none or another came."""
    if answer.ack is None or not isinstance(answer.ack.body, Transform):
        raise RobotRefusedError(f"no echo of the {what} came")
    refuse_other_pose(answer.ack.body.matrix, sent, what)
    return "as it was sent"
