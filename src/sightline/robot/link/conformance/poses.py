"""Questions about registrations and targets: accepted, echoed, and refused if they cannot be valid."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.link.client import RobotClient
from sightline.robot.link.conformance.asking import (
    REGISTRATION,
    Question,
    UnsupportedError,
    expect_code,
    expect_echo,
    require,
    target_in_air,
)
from sightline.robot.link.conformance.conversation import Conversation, NotAskedError
from sightline.robot.link.exchange import pose_of
from sightline.robot.link.wire_deviation import WireDeviation


def _takes_a_registration(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP", "CALIBRATION")
    return expect_code(talk.pose(contract.CALIBRATION, REGISTRATION.as_matrix()), Code.OK)


def _echoes_a_registration(robot: RobotClient) -> str:
    talk = Conversation(robot)
    talk.bring("START_UP", "CALIBRATION")
    sent = RigidTransform.from_components([512.5, -0.3, 3.7], Rotation.from_rotvec([0.1, -0.2, 0.3])).as_matrix()
    return expect_echo(talk.pose(contract.CALIBRATION, sent), sent, "registration")


def _no_registration(matrix: np.ndarray) -> Question:
    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        talk.bring("START_UP", "CALIBRATION")
        return expect_code(talk.pose(contract.CALIBRATION, matrix), Code.CONFIGURATION)

    return question


def _no_target(change: Callable[[np.ndarray], np.ndarray]) -> Question:
    """Return the question whether a target with one fault is refused; without the fault it was accepted."""

    def question(robot: RobotClient) -> str:
        talk = Conversation(robot)
        good = target_in_air(robot, talk)
        talk.bring("TARGETING")
        return expect_code(talk.pose(contract.TARGET, change(good)), Code.CONFIGURATION)

    return question


def _no_plan(**metadata: str) -> Question:
    """Return the question whether metadata are refused, for a pose that was accepted without them."""

    def question(robot: RobotClient) -> str:
        require(robot, contract.HAS_PLAN)
        talk = Conversation(robot)
        good = target_in_air(robot, talk)
        talk.bring("TARGETING")
        return expect_code(talk.pose(contract.TARGET, good, metadata), Code.CONFIGURATION)

    return question


def _in_metres(robot: RobotClient) -> str:
    """Ask whether a target in metres is refused; robots of the 2013 convention cannot detect it."""
    require(robot, contract.HAS_PLAN)
    return _no_target(lambda good: _moved(good, 1e-3 * good[:3, 3]))(robot)


def _echoes_a_target(robot: RobotClient) -> str:
    talk = Conversation(robot)
    good = target_in_air(robot, talk)
    talk.bring("TARGETING")
    return expect_echo(talk.pose(contract.TARGET, good), good, "target")


def _reaches_what_it_takes(robot: RobotClient) -> str:
    talk = Conversation(robot)
    good = target_in_air(robot, talk)
    talk.bring("TARGETING")
    answer = talk.pose(contract.TARGET, good)
    if answer.code != Code.OK:
        raise NotAskedError(f"the target was refused: {answer.text}")
    reachable = talk.next("REACHABLE_TARGET", contract.ACK_S)
    if reachable is None and not robot.capabilities:
        raise UnsupportedError("a robot of the 2013 convention does not report what it reaches")
    if reachable is None:
        raise RobotRefusedError("a target was accepted, but no REACHABLE_TARGET came")
    off = WireDeviation.of(pose_of(reachable), RigidTransform.from_matrix(good))
    off.refuse_large("the robot would lay the wire")
    return f"{off.aside_mm:.2f} mm beside its line"


def _moved(pose: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, 3] = to_mm
    return out


def _scaled(pose: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:3, :3] *= 2.0
    return out


_GENERAL = _moved(np.eye(4), np.array([500.0, 0.0, 0.0]))
_NAN = np.full(3, np.nan)
_PLAN = {
    contract.PLAN: "conformance", contract.SIDE: "right", contract.FRAME_SERIAL: "none", contract.GO: contract.NO,
    contract.UNITS: contract.MM, contract.COORDINATES: contract.CFCS, contract.LENGTH_MM: "90",
    contract.DEPTH_LIMIT_MM: "91", contract.VALID_S: "60",
}  # fmt: skip
_WITHOUT_SIDE = {key: value for key, value in (_PLAN | {contract.GO: contract.YES}).items() if key != contract.SIDE}


QUESTIONS: dict[str, Question] = {
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
    "plan that leaves out its side: 10": _no_plan(**_WITHOUT_SIDE),
}
