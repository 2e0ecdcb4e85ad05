"""Questions about registrations and targets, and the dry run: does motion stop on commands, silence and lost
connections, and end at its target?"""

from collections.abc import Callable, Iterable
from functools import partial
from time import sleep

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.errors import RobotRefusedError
from sightline.robot import contract
from sightline.robot.contract import Code
from sightline.robot.control.insertion import BARE_LENGTH_MM
from sightline.robot.link.client import MOTION_S
from sightline.robot.link.conformance.conversation import (
    IDENTIFIERS,
    REGISTRATION,
    SEVERAL,
    Conversation,
    NotAskedError,
    Question,
    UnsupportedError,
    accepted_plan,
    expect,
    expect_code,
    expect_echo,
    plan_name,
    target_in_air,
    verified_target,
)
from sightline.robot.link.exchange import TIP_LIMIT_MM, WireDeviation, number_of, pose_of


def _takes_a_registration(talk: Conversation) -> str:
    talk.bring("START_UP", "CALIBRATION")
    return expect_code(talk.pose(contract.CALIBRATION, REGISTRATION.as_matrix()), Code.OK)


def _echoes_a_registration(talk: Conversation) -> str:
    talk.bring("START_UP", "CALIBRATION")
    sent = RigidTransform.from_components([512.5, -0.3, 3.7], Rotation.from_rotvec([0.1, -0.2, 0.3])).as_matrix()
    return expect_echo(talk.pose(contract.CALIBRATION, sent), sent, "registration")


def _no_registration(matrix: np.ndarray, talk: Conversation) -> str:
    talk.bring("START_UP", "CALIBRATION")
    return expect_code(talk.pose(contract.CALIBRATION, matrix), Code.CONFIGURATION)


def _no_target(change: Callable[[np.ndarray], np.ndarray], talk: Conversation) -> str:
    """Ask whether a target with one fault is refused; without the fault it was accepted."""
    good, _ = target_in_air(talk)
    talk.bring("TARGETING")
    return expect_code(talk.pose(contract.TARGET, change(good)), Code.CONFIGURATION)


def _not_here(talk: Conversation, **metadata: str) -> str:
    """Ask whether metadata are refused, for a pose that was accepted without them."""
    talk.require(contract.HAS_PLAN)
    good, _ = target_in_air(talk)
    talk.bring("TARGETING")
    return expect_code(talk.pose(contract.TARGET, good, metadata), Code.CONFIGURATION)


def _no_plan(faults: Iterable[dict[str, str]], talk: Conversation) -> str:
    """Ask whether a plan with one of these faults is refused; without it, it was accepted.

    A fault is what the metadata say instead, "" where they leave it out.
    """
    return _refused_plans(talk, *accepted_plan(talk), faults)


def _other_side(talk: Conversation) -> str:
    good, plan = accepted_plan(talk)
    return _refused_plans(talk, good, plan, [{contract.SIDE: "left" if plan[contract.SIDE] == "right" else "right"}])


def _refused_plans(talk: Conversation, good: np.ndarray, plan: dict[str, str], faults: Iterable[dict[str, str]]) -> str:
    """Send a plan once with each fault and return the last refusal. Raises RobotRefusedError if one is accepted."""
    seen = ""
    for fault in faults:
        talk.bring("TARGETING")
        new = {contract.PLAN: plan_name()}  # a plan that is sent again keeps its first validity
        answer = talk.pose(contract.TARGET, good, {key: value for key, value in (plan | new | fault).items() if value})
        what = ", ".join(f"{key} {value or 'left out'}" for key, value in fault.items())
        expect(answer.code == Code.CONFIGURATION, f"with {what}: code {answer.code} {answer.text}; wanted 10")
        seen = answer.text
    return f"refused: {seen}"


def _registration_in_metres(talk: Conversation) -> str:
    talk.require(contract.HAS_PLAN)
    return _no_registration(_moved(_GENERAL, 1e-3 * _GENERAL[:3, 3]), talk)


def _in_metres(talk: Conversation) -> str:
    """Ask whether a target in metres is refused; robots of the 2013 convention cannot detect it."""
    talk.require(contract.HAS_PLAN)
    return _no_target(lambda good: _moved(good, 1e-3 * good[:3, 3]), talk)


def _keeps_its_first_validity(talk: Conversation) -> str:
    good, plan = accepted_plan(talk, **{contract.VALID_S: repr(VALID_S)})
    sleep(3 * VALID_S)
    talk.bring("TARGETING")
    return expect_code(talk.pose(contract.TARGET, good, plan | {contract.VALID_S: "60"}), Code.CONFIGURATION)


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


def _limits(key: str, *values: float | str) -> list[dict[str, str]]:
    return [{key: str(value)} for value in values]


QUESTIONS: dict[str, Question] = {
    "takes a registration": _takes_a_registration,
    "ACK echoes a registration": _echoes_a_registration,
    "registration that is no rotation: 10": partial(_no_registration, _scaled(_GENERAL)),
    "registration of NaN: 10": partial(_no_registration, _moved(_GENERAL, _NAN)),
    "registration in metres: 10": _registration_in_metres,
    "ACK echoes a target": _echoes_a_target,
    "REACHABLE_TARGET is the target": _reaches_what_it_takes,
    "target that is no rotation: 10": partial(_no_target, _scaled),
    "target of NaN: 10": partial(_no_target, lambda good: _moved(good, _NAN)),
    "target out of reach: 10": partial(_no_target, lambda good: _moved(good, good[:3, 3] + 5000.0)),
    "target in metres: 10": _in_metres,
    "target in another frame: 10": partial(_not_here, coordinates="RAS"),
    "target in another unit: 10": partial(_not_here, units="m"),
    "plan that is NO-GO: 10": partial(_no_plan, [{contract.GO: contract.NO}]),
    "plan that leaves out a key: 10": partial(
        _no_plan, [{key: ""} for key in contract.PLAN_KEYS if key != contract.PLAN]
    ),
    "plan of the other side: 10": _other_side,
    "plan of another frame: 10": partial(_no_plan, [{contract.FRAME_SERIAL: "conformance test"}]),
    "plan that has expired: 10": partial(_no_plan, _limits(contract.VALID_S, 0, -1)),
    "plan that is sent again after it expired: 10": _keeps_its_first_validity,
    "plan that is valid too long: 10": partial(_no_plan, _limits(contract.VALID_S, 601, "inf", "nan")),
    "plan without a depth limit: 10": partial(
        _no_plan,
        _limits(contract.DEPTH_LIMIT_MM, BARE_LENGTH_MM - 1, BARE_LENGTH_MM, BARE_LENGTH_MM + 31, "inf", "nan"),
    ),
    "plan whose depth is no number: 10": partial(_no_plan, _limits(contract.LENGTH_MM, "nan", "inf", "deep")),
}


# Time after which the robot must stand still on silence and for a lost connection [ours]. The first exceeds the
# contract's 0.2 s because a busy test computer observes it late; the observed time is reported. The second is short, so
# that the motion's own end is not mistaken for it.
SILENT_S, LOST_S = 1.5, 0.5
# Validity of the plan that expires; and for how long an aligned wire is watched: 0.1 mm within it are 0.3 mm within the
# half minute that a shot takes [ours].
VALID_S, HOLD_S = 0.5, 10.0


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


def _moves_nothing_in_manual(talk: Conversation) -> str:
    verified_target(talk)
    talk.bring("MANUAL")
    return talk.refused("MOVE_TO_TARGET", Code.MANUAL, Code.NOT_READY)


def _moves_nothing_expired(talk: Conversation) -> str:
    accepted_plan(talk, **{contract.VALID_S: repr(VALID_S)})
    sleep(3 * VALID_S)  # a simulator's clock may be slower
    return talk.refused("MOVE_TO_TARGET", Code.CONFIGURATION)


def _moves_nothing_refused(talk: Conversation) -> str:
    target = verified_target(talk)
    talk.bring("TARGETING")
    if talk.pose(contract.TARGET, _scaled(target)).code == Code.OK:
        raise NotAskedError("a target that is no rotation was accepted")
    return talk.refused("MOVE_TO_TARGET", Code.NOT_READY)


def _begins_nothing_unaligned(name: str, talk: Conversation) -> str:
    """Ask whether a robot that has a target, but is not aligned with it, refuses an activity."""
    talk.require(contract.HAS_DRILLING)
    verified_target(talk)
    return talk.refused(name, Code.NOT_READY)


def _drills_nothing_unwatched(talk: Conversation) -> str:
    talk.require(contract.HAS_DRILLING)
    talk.require(contract.HAS_HEARTBEAT)
    talk.robot.close()
    with talk.second() as quiet:
        _aligned(quiet)
        return quiet.refused("DRILL", Code.NOT_READY)


def _aligned(talk: Conversation, *, at_home: bool = False) -> np.ndarray:
    """Align and return the target, (4, 4) CFCS. Raises NotAskedError."""
    target = verified_target(talk, at_home=at_home)
    answer = talk.command("MOVE_TO_TARGET", within_s=MOTION_S)
    if answer.code != Code.OK:
        raise NotAskedError(f"it did not align: {answer.text or answer.code}")
    return target


def _holds_still(talk: Conversation) -> str:
    _aligned(talk)
    off = talk.moves(talk.tip(), HOLD_S)
    talk.command("STOP")
    expect(not off, f"the aligned wire drifts: {off} within {HOLD_S:g} s")
    return f"for {HOLD_S:g} s"


def _states_its_depth(talk: Conversation) -> str:
    talk.require(contract.HAS_DRILLING)
    if contract.HAS_GUIDE in talk.robot.capabilities:
        raise UnsupportedError(f"announces {contract.HAS_GUIDE}: a person drills, and it knows no depth")
    talk.require(contract.HAS_TELEMETRY)
    target = _aligned(talk)
    depth_mm, sd_mm = (number_of(talk.robot.connection.fresh(name)) for name in (contract.DEPTH, contract.DEPTH_SD))
    off = WireDeviation.of(talk.robot.position(), RigidTransform.from_matrix(target))
    talk.command("STOP")
    there_mm = BARE_LENGTH_MM + off.along_mm
    seen = f"{contract.DEPTH} {depth_mm:.2f} mm, s.d. {sd_mm:.2f} mm; by the pose {there_mm:.2f} mm"
    expect(abs(depth_mm - there_mm) <= TIP_LIMIT_MM and 0 < sd_mm < np.inf, seen)
    return seen


def _aligns(talk: Conversation) -> str:
    target = verified_target(talk, at_home=True)
    expect_code(talk.command("MOVE_TO_TARGET", within_s=MOTION_S), Code.OK)
    off = WireDeviation.of(talk.robot.position(), RigidTransform.from_matrix(target))
    talk.command("STOP")
    WireDeviation(off.aside_mm, 0.0, off.angle_rad).refuse_large("the aligned wire lies")
    before_mm = BARE_LENGTH_MM if contract.HAS_DRILLING in talk.robot.capabilities else 0.0
    beyond_mm = off.along_mm + before_mm
    what = "entry point" if before_mm else "end point"
    expect(beyond_mm <= TIP_LIMIT_MM, f"the tip of the aligned wire is {beyond_mm:.2f} mm beyond its {what}")
    return f"{off.aside_mm:.2f} mm beside its line, {-off.along_mm:.0f} mm before its end"


MOTIONS: dict[str, Question] = {
    "dry run: STOP while moving": _stops_while_moving,
    "dry run: STOP while moving, on a second connection": _stops_while_moving_from_elsewhere,
    "dry run: a repeated command moves nothing": _moves_once,
    "dry run: silence stops motion": _notices_silence,
    "dry run: a lost client's motion stops": _stops_for_a_lost_client,
    "dry run: MOVE_TO_TARGET in MANUAL: 14 or 13": _moves_nothing_in_manual,
    "dry run: MOVE_TO_TARGET by an expired plan: 10": _moves_nothing_expired,
    "dry run: MOVE_TO_TARGET after a refused target: 13": _moves_nothing_refused,
    "dry run: DRILL without alignment: 13": partial(_begins_nothing_unaligned, "DRILL"),
    "dry run: GUIDE without alignment: 13": partial(_begins_nothing_unaligned, "GUIDE"),
    "dry run: DRILL without heartbeats: 13": _drills_nothing_unwatched,
    "dry run: holds still when aligned": _holds_still,
    "dry run: states its depth": _states_its_depth,
    "dry run: aligns, and stands": _aligns,
}
