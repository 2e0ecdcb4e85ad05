"""Questions about registrations and targets, and the dry run: does motion stop on commands, silence and lost
connections, and end at its target?"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.link.client import MOTION_S
from sightline.robot.link.conformance.conversation import (
    IDENTIFIERS,
    REGISTRATION,
    SEVERAL,
    Conversation,
    NotAskedError,
    Question,
    UnsupportedError,
    expect_code,
    expect_echo,
    target_in_air,
    verified_target,
)
from sightline.robot.link.exchange import WireDeviation, pose_of


def _takes_a_registration(talk: Conversation) -> str:
    talk.bring("START_UP", "CALIBRATION")
    return expect_code(talk.pose(contract.CALIBRATION, REGISTRATION.as_matrix()), Code.OK)


def _echoes_a_registration(talk: Conversation) -> str:
    talk.bring("START_UP", "CALIBRATION")
    sent = RigidTransform.from_components([512.5, -0.3, 3.7], Rotation.from_rotvec([0.1, -0.2, 0.3])).as_matrix()
    return expect_echo(talk.pose(contract.CALIBRATION, sent), sent, "registration")


def _no_registration(matrix: np.ndarray) -> Question:
    def question(talk: Conversation) -> str:
        talk.bring("START_UP", "CALIBRATION")
        return expect_code(talk.pose(contract.CALIBRATION, matrix), Code.CONFIGURATION)

    return question


def _no_target(change: Callable[[np.ndarray], np.ndarray]) -> Question:
    """Return the question whether a target with one fault is refused; without the fault it was accepted."""

    def question(talk: Conversation) -> str:
        good, _ = target_in_air(talk)
        talk.bring("TARGETING")
        return expect_code(talk.pose(contract.TARGET, change(good)), Code.CONFIGURATION)

    return question


def _no_plan(**metadata: str) -> Question:
    """Return the question whether metadata are refused, for a pose that was accepted without them."""

    def question(talk: Conversation) -> str:
        talk.require(contract.HAS_PLAN)
        good, _ = target_in_air(talk)
        talk.bring("TARGETING")
        return expect_code(talk.pose(contract.TARGET, good, metadata), Code.CONFIGURATION)

    return question


def _in_metres(talk: Conversation) -> str:
    """Ask whether a target in metres is refused; robots of the 2013 convention cannot detect it."""
    talk.require(contract.HAS_PLAN)
    return _no_target(lambda good: _moved(good, 1e-3 * good[:3, 3]))(talk)


def _echoes_a_target(talk: Conversation) -> str:
    good, _ = target_in_air(talk)
    talk.bring("TARGETING")
    return expect_echo(talk.pose(contract.TARGET, good), good, "target")


def _reaches_what_it_takes(talk: Conversation) -> str:
    good, _ = target_in_air(talk)
    talk.bring("TARGETING")
    answer, reachable = talk.target(good)
    if answer.code != Code.OK:
        raise NotAskedError(f"the target was refused: {answer.text}")
    if reachable is None and not talk.robot.capabilities:
        raise UnsupportedError("a robot of the 2013 convention does not report what it reaches")
    if reachable is None:
        raise RobotRefusedError("a target was accepted, but no REACHABLE_TARGET came")
    off = WireDeviation.of(pose_of(reachable), RigidTransform.from_matrix(good))
    off.refuse_large("the robot would lay the wire")
    return f"{off.aside_mm:.2f} mm beside its line"


def _moved(pose: np.ndarray, to_mm: np.ndarray) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] = to_mm
    return moved


def _scaled(pose: np.ndarray) -> np.ndarray:
    scaled = pose.copy()
    scaled[:3, :3] *= 2.0
    return scaled


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


# Time after which the robot must stand still on silence and for a lost connection [ours]. The first exceeds the
# contract's 0.2 s because a busy test computer observes it late; the observed time is reported. The second is short, so
# that the motion's own end is not mistaken for it.
SILENT_S, LOST_S = 1.5, 0.5


def _stops_while_moving(talk: Conversation) -> str:
    verified_target(talk)
    with talk.moving() as moving:
        return moving.must_stand_after(lambda: talk.command("STOP"))


def _stops_while_moving_from_elsewhere(talk: Conversation) -> str:
    talk.require_ours(SEVERAL)
    verified_target(talk)
    with talk.second() as other, talk.moving() as moving:
        return moving.must_stand_after(lambda: other.command("STOP"))


def _moves_once(talk: Conversation) -> str:
    talk.require_ours(IDENTIFIERS)
    number = talk.robot.next_number()
    verified_target(talk)
    with talk.moving(number) as moving:
        try:
            moving.must_stand_after(lambda: talk.command("STOP"))
        except RobotRefusedError as error:
            raise NotAskedError(str(error)) from error
        try:
            return moving.must_not_begin_again(talk.command("MOVE_TO_TARGET", number=number, within_s=contract.ACK_S))
        finally:
            talk.command("STOP")


def _notices_silence(talk: Conversation) -> str:
    talk.require(contract.HAS_HEARTBEAT)
    talk.require(contract.HAS_TELEMETRY, "it cannot be watched in silence")
    verified_target(talk)
    with talk.moving() as moving:
        talk.robot.connection.fall_silent()
        try:
            return moving.must_stand_by_itself(SILENT_S)
        finally:
            talk.command("STOP")
            talk.robot.close()  # the next question has its heartbeats again


def _stops_for_a_lost_client(talk: Conversation) -> str:
    talk.require_ours(SEVERAL)
    talk.require(contract.HAS_TELEMETRY, "it cannot be watched by another")
    verified_target(talk)
    with talk.second() as other, talk.moving() as moving:
        talk.robot.close()
        moving.watch = other
        try:
            return moving.must_stand_by_itself(LOST_S)
        finally:
            other.command("STOP")


def _aligns(talk: Conversation) -> str:
    target = verified_target(talk)
    expect_code(talk.command("MOVE_TO_TARGET", within_s=MOTION_S), Code.OK)
    off = WireDeviation.of(talk.robot.position(), RigidTransform.from_matrix(target))
    talk.command("STOP")
    WireDeviation(off.aside_mm, 0.0, off.angle_rad).refuse_large("the aligned wire lies")
    return f"{off.aside_mm:.2f} mm beside its line, {-off.along_mm:.0f} mm before its end"


MOTIONS: dict[str, Question] = {
    "dry run: STOP while moving": _stops_while_moving,
    "dry run: STOP while moving, on a second connection": _stops_while_moving_from_elsewhere,
    "dry run: a repeated command moves nothing": _moves_once,
    "dry run: silence stops motion": _notices_silence,
    "dry run: a lost client's motion stops": _stops_for_a_lost_client,
    "dry run: aligns, and stands": _aligns,
}
