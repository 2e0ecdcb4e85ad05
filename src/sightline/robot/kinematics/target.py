"""Registration of the robot to the frame, the target of a plan with its errors, and the zero of depth.

The zero of depth is the planned entry point, corrected by bone contact and the check shot: plan, contact and shot are
combined with weights from their variances, and every depth is stated with its remaining error.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import hypot, isfinite, sqrt

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.checks import CLEAR_MM, Check, Limits, error_check
from sightline.common.geometry.covariance import both_within, length_quantile, line_direction
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.calibrated import CalibratedRobot

# The frame must not move between the images. A larger difference in its origin or direction than this is a movement,
# not the encoders' resolution [ours].
STILL_MM = 0.05
STILL_RAD = float(np.deg2rad(0.02))
# Largest time between an image and the reading of its pose [ours]: an arm that creeps at 0.2 mm/s is still meanwhile.
FRESH_S = 0.2
# Validity of a plan from its last image: patients breathe, tables sag [ours].
LIFETIME_S = 600.0
_CLOCK_S = 1.0  # [ours] tolerated disagreement of two readings of one clock: it may be set by a time server meanwhile
# Deflection of a wire by an oblique cortex with its sleeve at the bone, 1 s.d. per axis: 60 holes of 130° to 138°
# drilled in the twin, the sleeve 5 mm before the bone, gave 0.9 mrad, at most 3.5 [calc]. Four times that at 10 mm.
SKIVING_RAD = 1e-3
# Probability with which a drill must pass both walls of a nail: 97 % of the accepted drills are asked to [ours].
MIN_PASSING = 0.97
SIDES = ("right", "left")
# For the confirmation shot the wire, or the mouth of the guide, waits this far before the entry point, outside the skin
# of most patients [ours].
STANDOFF_MM = 20.0
# Of a wire in a guide: half its play at each end, uniform [ours, 0.05 mm of a lapped sleeve], and of a depth that a
# person reads as the free length of the wire, 1 s.d. [ours].
SLEEVE_SD_MM, READ_DEPTH_SD_MM = 0.05 / np.sqrt(12), 0.3


# Error of the planned entry along the wire, 1 s.d.: targets with a 95 % error above 1 mm are refused below.
PLAN_SD_MM = 0.5
# The point of a wire touches an oblique cortex beside its axis, so contact is detected this far before the axis meets
# bone. In healthy to osteoporotic femurs, fed at 1 mm/s: 0.55 mm, s.d. 0.12, along 60 ideal wires; 0.70 and 0.14 along
# lines some millimetres aside [benchmarks/supervision.py]. This includes the delay of the force filter; at 5 mm/s
# it is 0.1 mm more. A sharper point touches up to 0.6 mm later.
CONTACT_LEAD_MM, POINT_SD_MM = 0.6, 0.35
SURFACE_SD_MM = PLAN_SD_MM  # of the bone surface along the wire: a person marks it in the images as the entry point
CONTACT_SD_MM = hypot(POINT_SD_MM, SURFACE_SD_MM)
# Share of a difference between plan and contact by which contact moves the zero, and with it the wire's end: the error
# of contact alone moves both by 0.25 mm, 1 s.d.
CONTACT_WEIGHT = PLAN_SD_MM**2 / (PLAN_SD_MM**2 + CONTACT_SD_MM**2)
CONTACT_SHIFT_SD_MM = CONTACT_WEIGHT * CONTACT_SD_MM
SHOT_SD_MM = 0.2  # of the tip along the wire for a shot that states no error: clicked landmarks [docs/check-shot.md]
# Largest correction of the zero: four standard deviations of plan and contact.
MAX_ZERO_SHIFT_MM = 3.0
PAUSE_MM = 10.0  # before the end point, for the second shot [physics.md, Drilling]
HOLE_PAUSE_MM = 6.0  # before a nail: there a view from 40° shows the tip beside the nail [calc]


@dataclass(frozen=True)
class DepthZero:
    """The feed with the tip at the entry point, and its standard deviation; mm."""

    feed_mm: float
    sd_mm: float = PLAN_SD_MM

    def depth_mm(self, feed_mm: float) -> float:
        """Return the depth of the tip beyond the entry point at this feed, mm."""
        return feed_mm - self.feed_mm

    def corrected(self, feed_mm: float, depth_mm: float, sd_mm: float) -> "DepthZero":
        """Return the zero corrected by a measured depth of the tip with standard deviation `sd_mm`. Raises
        RobotRefusedError if the correction exceeds MAX_ZERO_SHIFT_MM."""
        off = self.depth_mm(feed_mm) - depth_mm
        if not (isfinite(off) and abs(off) <= MAX_ZERO_SHIFT_MM and 0 < sd_mm <= MAX_ZERO_SHIFT_MM):
            raise RobotRefusedError(
                f"what was seen puts the tip at {depth_mm:.1f} mm, the encoders at {self.depth_mm(feed_mm):.1f} mm: "
                f"more than {MAX_ZERO_SHIFT_MM:g} mm apart, something has moved; take new images and plan again"
            )
        weight = self.sd_mm**2 / (self.sd_mm**2 + sd_mm**2)
        return DepthZero(self.feed_mm + weight * off, self.sd_mm * sqrt(1 - weight))


def contact_range(before_mm: float = 0.0) -> tuple[float, float]:
    """Return the first and the last depth, mm, at which contact with bone is plausible.

    `before_mm`: how far before the entry point bone may begin (`Limits.before_mm`).
    """
    earliest = -before_mm - MAX_ZERO_SHIFT_MM - CONTACT_LEAD_MM
    return earliest, (-CLEAR_MM if before_mm > 0 else MAX_ZERO_SHIFT_MM) - CONTACT_LEAD_MM


def pause_depth(depth_mm: float, limits: Limits) -> float:
    """Return the depth, mm, of the pause for the second shot, for a wire that is drilled to `depth_mm`.

    A drill that goes through what lies in the bone, such as a nail's hole, pauses before it.
    """
    if limits.through_walls:
        return -HOLE_PAUSE_MM
    return max(depth_mm - PAUSE_MM, 0.0)


@dataclass(frozen=True, eq=False)
class PoseAtImage:
    """Encoder readings for one image: joints `q` (n,) read at `read_s`, image acquired at `imaged_s`, in seconds of the
    same clock. `stated` (6, 6): covariance of the flange's pose where `q` is made from it, a twist in flange
    coordinates, rad and mm."""

    q: np.ndarray
    read_s: float
    imaged_s: float
    stated: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of the frame at the images. `T_mcs_cfcs`: from the mean joints `q` (n,) of all images, which hardly differ;
    `of_view`: from each view's own joints; `imaged_s`: time of the last image; `stated`: as of `PoseAtImage`, the
    largest."""

    robot: CalibratedRobot
    q: np.ndarray
    T_mcs_cfcs: RigidTransform
    of_view: dict[str, RigidTransform]
    imaged_s: float
    stated: np.ndarray | None = None


def register(robot: CalibratedRobot, poses: Mapping[str, PoseAtImage]) -> Registration:
    """Return the registration from the pose at each image, by view.

    Raises UnusableInputError without poses, and for a pose whose joints or times are not all finite;
    RobotRefusedError for a pose that is stale or beyond the joint limits, and for a robot that moved between the
    images.
    """
    if not poses:
        raise UnusableInputError(
            "acquire the images with the robot connected: a registration needs the robot's pose at each image"
        )
    for view, pose in poses.items():
        _refuse_unusable(robot, view, pose)
    manipulator = robot.manipulator
    of_view = {view: manipulator.T_mcs_cfcs(pose.q) for view, pose in poses.items()}
    q = np.mean([pose.q for pose in poses.values()], axis=0)
    middle = manipulator.T_mcs_cfcs(q)
    for view, pose in of_view.items():
        moved = middle.inv() * pose
        shift, rotation = np.linalg.norm(moved.translation), moved.rotation.magnitude()
        if shift > STILL_MM or rotation > STILL_RAD:
            raise RobotRefusedError(
                "hold the robot still and acquire both images again: it moved between the images. At the "
                f"{view} image the frame was {shift:.2f} mm and {np.rad2deg(rotation):.3f}° from its mean pose (at "
                f"most {STILL_MM:g} mm and {np.rad2deg(STILL_RAD):.2f}°)"
            )
    stated = max((pose.stated for pose in poses.values() if pose.stated is not None), key=np.trace, default=None)
    return Registration(robot, q, middle, of_view, max(pose.imaged_s for pose in poses.values()), stated)


def _refuse_unusable(robot: CalibratedRobot, view: str, pose: PoseAtImage) -> None:
    finite, age_s = int(np.isfinite(pose.q).sum()), abs(pose.read_s - pose.imaged_s)
    manipulator = robot.manipulator
    if np.shape(pose.q) != (manipulator.count,) or finite < manipulator.count:
        raise UnusableInputError(
            f"acquire the images again with the robot connected: the pose at the {view} image has {finite} finite "
            f"joint values ({manipulator.count} needed)"
        )
    if not np.isfinite(age_s):
        raise UnusableInputError(f"acquire the {view} image again: its time or the time of its pose is not finite")
    if age_s > FRESH_S:
        raise RobotRefusedError(
            f"check that robot and images share a clock, and acquire the {view} image again: the robot's pose was read "
            f"{age_s:.2f} s from it (at most {FRESH_S:g} s)"
        )
    if text := manipulator.excesses(pose.q, "is at"):
        raise RobotRefusedError(
            "load this robot's calibration, or home the robot; then acquire both images again: at the "
            f"{view} image {text}"
        )


@dataclass(frozen=True)
class PlanIdentity:
    """Identity of a plan: its identifier, the patient's side, the frame's serial, whether planning says GO, the kind of
    trajectory, and the fingerprint of the frame's file. The last two are "" if a peer does not state them."""

    plan: str
    side: str
    frame_serial: str
    go: bool
    kind: str = ""
    frame: str = ""

    def __post_init__(self) -> None:
        if not self.plan or self.side not in SIDES:
            raise UnusableInputError("a plan for a robot needs an identifier and a side, 'right' or 'left'")


@dataclass(frozen=True, eq=False)
class RobotTarget:
    """A trajectory in MCS: `entry_mm`, `end_mm` (3,), the joints `q` (n,) with the tip at the entry point, or without
    a feed the guide's mouth at the stand-off before it, and its expiry time. `covariance_mm2` (6, 6): of (entry, end)
    of the wire in the bone, which includes errors that the encoders cannot see. `budget_mm2`: the share of each source,
    of planning and of the robot. `limits`: the plan's."""

    identity: PlanIdentity
    registration: Registration
    entry_mm: np.ndarray
    end_mm: np.ndarray
    q: np.ndarray
    covariance_mm2: np.ndarray
    budget_mm2: dict[str, np.ndarray]
    expires_s: float
    limits: Limits

    @property
    def length_mm(self) -> float:
        """Distance from entry to end point, mm."""
        return float(np.linalg.norm(self.end_mm - self.entry_mm))

    @property
    def depth_mm(self) -> float:
        """Depth of the tip beyond the entry point when drilled, mm: past the end point if the plan says so."""
        return self.length_mm + self.limits.beyond_mm

    def depth_at(self, q: np.ndarray) -> float:
        """Return the depth of the tip beyond the entry point at the joints `q` (n,) on the target's line, mm."""
        feed = self.registration.robot.manipulator.feed
        return float(q[feed] - self.q[feed])

    @property
    def standoff_mm(self) -> float:
        """Distance before the entry point at which the wire, or the guide's mouth, waits for the confirmation shot."""
        return STANDOFF_MM + self.limits.before_mm

    @property
    def pushed_mm(self) -> float:
        """Length of wire that leaves the mouth of a guide when it is drilled, mm."""
        return self.standoff_mm + self.depth_mm

    @property
    def T_cfcs_wire(self) -> RigidTransform:
        """Pose of the wire when it is drilled, CFCS, +z towards the tip; its rotation about +z is the robot's own."""
        manipulator = self.registration.robot.manipulator
        by_mm = self.depth_mm if manipulator.has_feed else self.pushed_mm
        return self.registration.T_mcs_cfcs.inv() * manipulator.along(self.q, by_mm)

    @cached_property
    def entry_error_95_mm(self) -> float:
        """With a probability of 95 % the wire enters nearer than this to the entry point."""
        return float(length_quantile(self.covariance_mm2[:3, :3]))

    @cached_property
    def end_error_95_mm(self) -> float:
        """With a probability of 95 % the tip ends nearer than this to the end point."""
        return float(length_quantile(self.covariance_mm2[3:, 3:]))

    @cached_property
    def direction_error_95_rad(self) -> float:
        """With a probability of 95 % the error of the wire's direction is smaller."""
        to_direction = line_direction(self.entry_mm, self.end_mm)
        return float(length_quantile(to_direction @ self.covariance_mm2 @ to_direction.T))

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the target, including the robot's errors."""
        degrees = (float(np.rad2deg(self.direction_error_95_rad)), float(np.rad2deg(self.limits.direction_rad)))
        values = (
            ("wire entry error", "entry point", self.entry_error_95_mm, self.limits.position_mm, "mm"),
            ("wire end error", "tip", self.end_error_95_mm, self.limits.position_mm, "mm"),
            ("wire direction error", "direction", *degrees, "°"),
        )
        go = self.identity.go
        text = "Planning says GO." if go else "Planning says NO-GO: see its checks, and plan again."
        errors = tuple(self._check(*value) for value in values)
        return (Check("plan go", go, None, None, "", text), *errors, *self._through_walls())

    def refuse_unfit(self, now_s: float) -> None:
        """Raise RobotRefusedError if a check failed, the target has expired, or its images are dated in the future."""
        failed = [check.sentence for check in self.checks if not check.passed]
        if failed:
            raise RobotRefusedError(f"the plan must not be drilled: {' '.join(failed)}")
        if not now_s <= self.expires_s:
            raise RobotRefusedError(
                f"the plan expired {now_s - self.expires_s:.0f} s ago ({LIFETIME_S / 60:g} minutes after its images); "
                "take new images and plan again"
            )
        if (ahead_s := self.expires_s - LIFETIME_S - now_s) > _CLOCK_S:
            raise RobotRefusedError(
                f"the plan's images are dated {ahead_s:.0f} s in the future: the clock was set back since, so their "
                "age is unknown; take new images and plan again"
            )

    def _through_walls(self) -> tuple[Check, ...]:
        """Return the check of a drill that passes both of its points, as through a nail's walls: a drill that misses at
        either end touches. Errors along the drill do not count."""
        if not self.limits.through_walls:
            return ()
        across = np.kron(np.eye(2), np.linalg.svd((self.end_mm - self.entry_mm)[None])[2][1:])
        share = both_within(across @ self.covariance_mm2 @ across.T, self.limits.position_mm)
        passed = share >= MIN_PASSING
        shown = 100 * share if passed else min(100 * share, 100 * MIN_PASSING - 0.1)  # never rounded up to its limit
        text = f"By the stated errors the drill passes both walls with a probability of {shown:.1f} % "
        text += (
            f"(at least {100 * MIN_PASSING:g} %{'' if passed else f' is needed; largest share: {self._largest()}'})."
        )
        return (Check("wire through both walls", passed, 100 * share, 100 * MIN_PASSING, "%", text),)

    def _check(self, name: str, what: str, value: float, limit: float, unit: str) -> Check:
        return error_check(name, f"drilled {what}", value, limit, unit, advice=f"largest share: {self._largest()}")

    def _largest(self) -> str:
        return max(self.budget_mm2, key=lambda source: np.trace(self.budget_mm2[source])).replace("_", " ")


def robot_target(
    identity: PlanIdentity,
    points_mm: np.ndarray,
    budget_mm2: Mapping[str, np.ndarray] | None,
    registration: Registration,
    limits: Limits,
) -> RobotTarget:
    """Return the robot's target for a planned trajectory.

    `points_mm` (2, 3): entry and end point, CFCS. `budget_mm2`: covariance (6, 6) of each source of planning's error
    (`SpacePoints.budget_mm2`); None if a view states no error. `limits`: the plan's. Raises RobotRefusedError if the
    error is unknown, entry and end coincide, or the line is out of reach.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if points.shape != (2, 3) or not np.isfinite(points).all():
        raise UnusableInputError("a trajectory has an entry and an end point of three finite coordinates each")
    if budget_mm2 is None:
        raise RobotRefusedError("the plan's error is unknown: a view states no covariance; calibrate both from beads")
    entry, end = registration.T_mcs_cfcs.apply(points)
    robot = registration.robot
    manipulator, standoff_mm = robot.manipulator, STANDOFF_MM + limits.before_mm
    if manipulator.has_feed:
        q = manipulator.inverse(entry, end)
        q_end = manipulator.fed(q, float(np.linalg.norm(end - entry)) + limits.beyond_mm)
        if short := manipulator.beyond_limits(q_end)[manipulator.feed]:
            raise RobotRefusedError(
                f"the feed ends {short:.1f} mm before the planned depth; bring the robot's base nearer, or plan a "
                "shorter wire"
            )
    else:
        q = manipulator.inverse(entry, end, -standoff_mm, registration.q)
    to_mcs = np.kron(np.eye(2), registration.T_mcs_cfcs.rotation.as_matrix())
    budget = {source: to_mcs @ covariance @ to_mcs.T for source, covariance in budget_mm2.items()}
    # The robot rotates about the wire where something is in its way: the largest of its errors is stated.
    by_rotation = [
        robot.wire_against_frame(registration.q, joints, np.stack([entry, end]), registration.stated)
        for joints in (q, *manipulator.turned(q))
    ]
    budget |= max(by_rotation, key=lambda shares: np.trace(sum(shares.values(), np.zeros((6, 6)))))
    budget["skiving"] = _skiving(entry, end)
    if not manipulator.has_feed:
        budget["sleeve"] = _sleeve(entry, end, standoff_mm, manipulator.guide_mm)
    covariance = np.sum(list(budget.values()), axis=0)
    # A wire that goes past its end point passes it whatever its depth, and contact with bone that begins somewhere
    # before the entry point says nothing of the depth.
    by_contact = limits.beyond_mm == limits.before_mm == 0 and manipulator.has_feed
    budget["depth_zero"] = _depth_zero(entry, end, covariance) if by_contact else np.zeros((6, 6))
    covariance = covariance + budget["depth_zero"]
    expires_s = registration.imaged_s + LIFETIME_S
    return RobotTarget(identity, registration, entry, end, q, covariance, budget, expires_s, limits)


def _skiving(entry_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) mm² of (entry, end) from skiving: the wire rotates about its entry point."""
    along = end_mm - entry_mm
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = SKIVING_RAD**2 * ((along @ along) * np.eye(3) - np.outer(along, along))
    return covariance


def _sleeve(entry_mm: np.ndarray, end_mm: np.ndarray, standoff_mm: float, guide_mm: float) -> np.ndarray:
    """Return the covariance (6, 6) mm² of (entry, end) of a wire that a person drills through a guide: its play at both
    ends of the guide, carried on straight, and the depth that is read."""
    along = (end_mm - entry_mm) / np.linalg.norm(end_mm - entry_mm)
    beyond = np.array([standoff_mm, standoff_mm + np.linalg.norm(end_mm - entry_mm)]) / guide_mm
    carried = SLEEVE_SD_MM * np.stack([1 + beyond, -beyond], axis=1)  # by the play at the mouth, and at the other end
    across = np.kron(carried @ carried.T, np.eye(3) - np.outer(along, along))
    return across + READ_DEPTH_SD_MM**2 * np.kron(np.diag([0.0, 1.0]), np.outer(along, along))


def _depth_zero(entry_mm: np.ndarray, end_mm: np.ndarray, others_mm2: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) mm² of (entry, end) that contact adds along the wire to that of the other sources.

    Contact shifts the zero of depth by CONTACT_WEIGHT of its difference from the planned entry: it corrects part of the
    other errors and adds its own. Where it corrects more, nothing is added: in a bore there is no contact.
    """
    along = (end_mm - entry_mm) / np.linalg.norm(end_mm - entry_mm)
    corrected, end = np.concatenate([-CONTACT_WEIGHT * along, along]), np.concatenate([np.zeros(3), along])
    added = corrected @ others_mm2 @ corrected + CONTACT_SHIFT_SD_MM**2 - end @ others_mm2 @ end
    return max(float(added), 0.0) * np.outer(end, end)
