"""Registration and insertion, read from the messages that arrive over the link, or refused."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.checks import CLEAR_MM, MAX_BEFORE_MM, Limits, failed
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot import contract
from sightline.robot.igtl import Message, Transform
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.reach import check_reach, hip_surroundings
from sightline.robot.kinematics.target import LIFETIME_S, STANDOFF_MM, PlanIdentity

# Feed of a retracted wire before the joint's limit: inside it, so that drives still obey [ours].
IN_SLEEVE_MM = 0.5
# A guide comes from this far off along the wire's axis, in steps that stay on it to 0.06 mm [ours].
FROM_MM, STRAIGHT_MM = 60.0, 20.0
BARE_LENGTH_MM = 95.0  # entry to tip for a target without entry point: the wire of the paper's hip [paper]
MIN_LENGTH_MM = 5.0  # as in planning: a shorter distance gives no direction
# Depth limit past the planned depth for a target that states none: the paper's limit for the tip [paper, Fig. 15].
DEPTH_SLACK_MM = 1.0
# Between planned depth and depth limit [ours]: at least the feed error at rest with a margin; at most what lies before
# a bone's far surface: a femoral head has a radius of 20 to 30 mm.
MIN_SLACK_MM, MAX_SLACK_MM = 0.2, 30.0
# A base this near the hip, or a target this near the frame's origin, mm, must have been sent in metres [ours].
BASE_IN_METRES, TARGET_IN_METRES = 10.0, 1.0
_SAME_Q = 1e-6  # mm or rad: what the inverse's start makes of the same line is 1e-9


@dataclass(frozen=True, eq=False)
class OwnFrames:
    """Frames for clients of the 2013 convention. Their registration maps a base frame of the robot (`T_mcs_base`) to a
    patient frame that does not locate the hip; the hip is where it was set up (`T_mcs_hip`, axes of CFCS)."""

    T_mcs_base: RigidTransform
    T_mcs_hip: RigidTransform


@dataclass(frozen=True)
class Setup:
    """Settings that a person has confirmed at the robot.

    `side`: of the patient; `frame_serial`; `frame_mounted`: a Γ frame is still on the flange (a block comes off before
    the arm moves: False); `remount_mm`: its repeatability if it was removed since its calibration; `into_bone`: bone is
    expected at the entry point, which is false in a dry run and in a bore. `frames`: None for registrations as in
    docs/robot-link.md. `frame`: fingerprint of the frame's file, "" if unknown. `hip_mm` (3,), CFCS: where the hip
    lies, for the collision check: at the origin of a Γ frame, beside a block. `c_arm_away`: the C-arm, whose beams lie
    along the wire, is drawn back before the arm moves.
    """

    side: str
    frame_serial: str
    frame_mounted: bool = True
    remount_mm: float | None = None
    into_bone: bool = True
    frames: OwnFrames | None = None
    frame: str = ""
    hip_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    c_arm_away: bool = False


@dataclass(frozen=True, eq=False)
class LinkRegistration:
    """Pose of the frame at the images, from navigation. `timestamp`: that of the message, 0 if not stated."""

    T_mcs_cfcs: RigidTransform
    timestamp: int


@dataclass(frozen=True, eq=False)
class Insertion:
    """A wire to be drilled. `entry_mm`, `end_mm` (3,) MCS; `q` (n,): as of `RobotTarget`.

    `sent`: the pose at the end point as received. Depths count from the entry point. `identity` is None for a bare
    transform. `limits`: of them only `beyond_mm` and `before_mm` count.
    """

    identity: PlanIdentity | None
    T_mcs_cfcs: RigidTransform
    entry_mm: np.ndarray
    end_mm: np.ndarray
    q: np.ndarray
    sent: Transform
    depth_limit_mm: float
    expires_s: float
    limits: Limits

    @property
    def length_mm(self) -> float:
        """Distance from entry to end point, mm."""
        return float(np.linalg.norm(self.end_mm - self.entry_mm))

    @property
    def standoff_mm(self) -> float:
        """Distance before the entry point at which the wire waits for the confirmation shot."""
        return STANDOFF_MM + self.limits.before_mm

    def T_cfcs_wire(self, manipulator: Manipulator) -> RigidTransform:
        """Return the pose at the end point, CFCS, that the robot will reach."""
        beyond_mm = self.length_mm + (0.0 if manipulator.has_feed else self.standoff_mm)
        return self.T_mcs_cfcs.inv() * manipulator.along(self.q, beyond_mm)

    def is_same(self, other: "Insertion") -> bool:
        """Return whether the other has this registration and target, number for number, and leads to these joints."""
        ours, theirs = ((one.T_mcs_cfcs.as_matrix(), one.sent.matrix) for one in (self, other))
        return (
            all(map(np.array_equal, ours, theirs))
            and (self.length_mm, self.limits) == (other.length_mm, other.limits)
            and np.allclose(self.q, other.q, atol=_SAME_Q)
        )

    def waypoints(self, manipulator: Manipulator, q: np.ndarray) -> np.ndarray:
        """Return the joints (K, n) from `q` (n,) to the stand-off: wire back, arm to its line, wire forward; or the
        guide to its line, and along it."""
        if not manipulator.has_feed:
            return np.vstack([q, guide_back(manipulator, self.q)[::-1], self.q])
        back = retracted(manipulator, q)
        on_line = retracted(manipulator, self.q)
        return np.stack([q, back, on_line, manipulator.fed(self.q, -self.standoff_mm)])

    def cleared(self, manipulator: Manipulator, q: np.ndarray, setup: Setup) -> "Insertion":
        """Return the insertion if its path from the joints `q` (n,) to the end point keeps clear of all obstacles; else
        the same wire with the least other rotation about its axis that does. Raises RobotRefusedError with what is in
        the way without one."""
        at_hip = self.T_mcs_cfcs * RigidTransform.from_translation(setup.hip_mm)
        T_mcs_hip = at_hip if setup.frames is None else setup.frames.T_mcs_hip
        theatre = hip_surroundings(T_mcs_hip, setup.frame_mounted, setup.remount_mm, c_arm=not setup.c_arm_away)
        bad = failed(check_reach(manipulator, self._path(manipulator, q), theatre))
        for joints in manipulator.turned(self.q) if bad else ():
            if failed(check_reach(manipulator, joints[None], theatre)):
                continue  # at its end, which takes a fraction of the time
            turned = replace(self, q=joints)
            with suppress(RobotRefusedError):  # the guide cannot follow the line
                if not failed(check_reach(manipulator, turned._path(manipulator, q), theatre)):
                    return turned
        if bad:
            raise RobotRefusedError(" ".join(check.sentence for check in bad))
        return self

    def _path(self, manipulator: Manipulator, q: np.ndarray) -> np.ndarray:
        way = self.waypoints(manipulator, q)
        return np.vstack([way, manipulator.fed(self.q, self.length_mm)]) if manipulator.has_feed else way


def retracted(manipulator: Manipulator, q: np.ndarray) -> np.ndarray:
    """Return the joints (n,) with the wire in its sleeve."""
    back = np.array(q, dtype=np.float64)
    back[manipulator.feed] = manipulator.lower[manipulator.feed] + IN_SLEEVE_MM
    return back


def guide_back(manipulator: Manipulator, q: np.ndarray) -> np.ndarray:
    """Return the joints (K, n) that draw the guide back along the wire's axis. Raises RobotRefusedError."""
    return manipulator.follow_line(q, -np.arange(STRAIGHT_MM, FROM_MM + 1.0, STRAIGHT_MM))


def read_registration(message: Message, setup: Setup) -> LinkRegistration:
    """Return the registration in a transform from MCS, or the base frame of 2013, to CFCS. Raises RobotRefusedError."""
    T_cfcs_mcs = _rigid(message, "registration").rigid()
    if setup.frames is not None:
        return LinkRegistration(setup.frames.T_mcs_base * T_cfcs_mcs.inv(), message.timestamp)
    distance = float(np.linalg.norm(T_cfcs_mcs.translation))
    if distance < BASE_IN_METRES:
        raise RobotRefusedError(
            f"the registration puts the robot's base {distance:.2f} mm from the hip: it looks like metres; send mm"
        )
    return LinkRegistration(T_cfcs_mcs.inv(), message.timestamp)


def read_target(
    message: Message,
    registration: LinkRegistration,
    robot: CalibratedRobot,
    setup: Setup,
    now_s: float,
    *,
    near: np.ndarray | None = None,
) -> Insertion:
    """Return the insertion in a transform: the wire's pose at the end point, CFCS, +z towards the tip, with the plan's
    metadata if any. `near` (n,): as of `Manipulator.solutions`.

    `Insertion.cleared` checks the path from the robot's position later. Raises RobotRefusedError with the
    reason.
    """
    sent = _rigid(message, "target")
    T_cfcs_wire = sent.rigid()
    metadata = message.metadata
    _refuse_frame_and_units(metadata)
    if setup.frames is None:
        _refuse_metres(T_cfcs_wire)
    if message.timestamp and registration.timestamp and message.timestamp < registration.timestamp:
        raise RobotRefusedError("the target is older than the registration; plan again on the images just taken")
    identity, length, limit, expires = None, BARE_LENGTH_MM, BARE_LENGTH_MM + DEPTH_SLACK_MM, now_s + LIFETIME_S
    limits = Limits()
    if contract.PLAN in metadata:
        identity, length, limit, valid = _plan(metadata, setup)
        expires, limits = now_s + valid, _beside_bone(metadata, length)
    end = registration.T_mcs_cfcs.apply(T_cfcs_wire.translation)
    along = (registration.T_mcs_cfcs * T_cfcs_wire).rotation.apply([0.0, 0.0, 1.0])
    entry = end - length * along
    manipulator, depth = robot.manipulator, 0.0 if robot.manipulator.has_feed else -STANDOFF_MM - limits.before_mm
    q = manipulator.inverse(entry, end, depth, near)
    if manipulator.has_feed:
        refuse_feed(manipulator, q, length, limits.before_mm)
    return Insertion(identity, registration.T_mcs_cfcs, entry, end, q, sent, limit, expires, limits)


def refuse_feed(manipulator: Manipulator, q: np.ndarray, length_mm: float, before_mm: float = 0.0) -> None:
    """Raise RobotRefusedError if the feed cannot go from the stand-off to the end point. `before_mm`: how far before
    the entry point bone may begin."""
    off, feed = STANDOFF_MM + before_mm, manipulator.feed
    before, beyond = q[feed] - off - manipulator.lower[feed], q[feed] + length_mm - manipulator.upper[feed]
    if before < 0:
        raise RobotRefusedError(
            f"the entry point is {-before:.1f} mm too near: the wire must stop {off:g} mm before it; move the robot's "
            "base away"
        )
    if beyond > 0:
        raise RobotRefusedError(
            f"the feed ends {beyond:.1f} mm before the end point; bring the robot's base nearer, or plan a shorter wire"
        )


def _rigid(message: Message, what: str) -> Transform:
    body = message.body
    if not isinstance(body, Transform):
        raise RobotRefusedError(f"a {what} comes as TRANSFORM, not as {message.type_name}")
    if body.fault is not None:
        raise RobotRefusedError(f"the {what} is no rigid motion: {body.fault}")
    return body


def _refuse_frame_and_units(metadata: Mapping[str, str]) -> None:
    frame, units = metadata.get(contract.COORDINATES, contract.CFCS), metadata.get(contract.UNITS, contract.MM)
    if frame != contract.CFCS:
        raise RobotRefusedError(f"the target is in the frame {frame!r}; send it in {contract.CFCS}")
    if units != contract.MM:
        raise RobotRefusedError(f"the target is in {units!r}; send it in {contract.MM}")


def _refuse_metres(T_cfcs_wire: RigidTransform) -> None:
    distance = float(np.linalg.norm(T_cfcs_wire.translation))
    if distance < TARGET_IN_METRES:
        raise RobotRefusedError(
            f"the target lies {distance:.3f} mm from the frame's origin: it looks like metres; send mm (a target that "
            f"truly lies within {TARGET_IN_METRES:g} mm must be planned a little aside)"
        )


def _plan(metadata: Mapping[str, str], setup: Setup) -> tuple[PlanIdentity, float, float, float]:
    """Return (identity, length mm, depth limit mm, remaining validity s)."""
    missing = [key for key in contract.PLAN_KEYS if key not in metadata]
    if missing:
        raise RobotRefusedError(f"the plan {metadata[contract.PLAN]!r} does not state {', '.join(missing)}")
    go = metadata[contract.GO]
    if go not in (contract.YES, contract.NO):
        raise RobotRefusedError(f"{contract.GO} is {contract.YES!r} or {contract.NO!r}, not {go!r}")
    try:
        identity = PlanIdentity(
            metadata[contract.PLAN],
            metadata[contract.SIDE],
            metadata[contract.FRAME_SERIAL],
            go == contract.YES,
            metadata.get(contract.KIND, ""),
            metadata.get(contract.FRAME, ""),
        )
    except UnusableInputError as error:
        raise RobotRefusedError(str(error)) from error
    if not identity.go:
        raise RobotRefusedError("checks of the plan failed: planning says NO-GO; see them, and plan again")
    for what, planned, here in (
        ("side", identity.side, setup.side),
        ("frame serial", identity.frame_serial, setup.frame_serial),
        ("frame file", identity.frame or setup.frame, setup.frame or identity.frame),  # where both state it
    ):
        if planned != here:
            raise RobotRefusedError(
                f"the plan's {what} is {planned!r}, the robot is set up for {here!r}: not this patient's plan, or not "
                "this frame; find out which before anything else"
            )
    length, limit, valid = (
        _number(metadata, key) for key in (contract.LENGTH_MM, contract.DEPTH_LIMIT_MM, contract.VALID_S)
    )
    if length < MIN_LENGTH_MM:
        raise RobotRefusedError(
            f"entry and end point are {length:.1f} mm apart and give no direction (at least {MIN_LENGTH_MM:g} mm); "
            "plan again"
        )
    if limit < length + MIN_SLACK_MM:
        raise RobotRefusedError(
            f"the planned depth of {length:.1f} mm comes within {MIN_SLACK_MM:g} mm of its limit of {limit:.1f} mm "
            "or passes it; plan a shorter wire"
        )
    if limit > length + MAX_SLACK_MM:
        raise RobotRefusedError(
            f"the depth limit of {limit:.4g} mm lies {limit - length:.4g} mm beyond the planned depth of {length:.1f} "
            f"mm, where no bone is (at most {MAX_SLACK_MM:g} mm); state the distance to the bone's far surface"
        )
    if not 0 < valid <= LIFETIME_S:
        raise RobotRefusedError(
            "the plan has expired; take new images and plan again"
            if valid <= 0
            else f"the plan claims to be valid for {valid:.0f} s; at most {LIFETIME_S:.0f} s are"
        )
    return identity, length, limit, valid


def _beside_bone(metadata: Mapping[str, str], length_mm: float) -> Limits:
    """Return how far past the end point the wire is drilled, and how far before the entry point bone may begin."""
    beyond, before = (
        _number(metadata, key) if key in metadata else 0.0 for key in (contract.BEYOND_MM, contract.BEFORE_MM)
    )
    if not 0.0 <= beyond < length_mm:
        raise RobotRefusedError(f"{contract.BEYOND_MM} is {beyond:g}: it is a part of the length of {length_mm:.1f} mm")
    if before != 0.0 and not CLEAR_MM < before <= MAX_BEFORE_MM:
        raise RobotRefusedError(
            f"bone is said to begin up to {before:g} mm before the entry point; this must be 0, or between "
            f"{CLEAR_MM:g} and {MAX_BEFORE_MM:g} mm: correct before_mm of the procedure"
        )
    return Limits(beyond_mm=beyond, before_mm=before)


def _number(metadata: Mapping[str, str], key: str) -> float:
    try:
        value = float(metadata[key])
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise RobotRefusedError(f"{key} is {metadata[key]!r}, which is no number")
    return value
