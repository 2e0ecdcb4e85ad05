"""The robot's file: its calibration, its identity, and its pose at the images."""

from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from datetime import UTC, datetime, timedelta
from json import JSONDecodeError, loads
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.spatial.transform import RigidTransform

from sightline.common.atomic import write_whole
from sightline.common.bounded import MAX_TEXT_BYTES, read_bounded
from sightline.common.geometry.rigid import why_not_rigid
from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.calibrated import (
    CalibratedAxes,
    CalibratedRobot,
    Mount,
    calibrate_axes,
    measured_axis,
    measured_mount,
    seen_axis,
)
from sightline.robot.kinematics.designs import DESIGNS, Design, nominal_manipulator
from sightline.robot.kinematics.manipulator import Capsule, Manipulator
from sightline.robot.kinematics.model_file import read_arm
from sightline.robot.kinematics.target import LIFETIME_S, PoseAtImage, Registration, register

CALIBRATION_DAYS = 90  # validity of a calibration: a knock on the flange goes unnoticed [ours]
VIEWS = ("pa", "lateral")

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0, le=10)]
Serial = Annotated[str, Field(min_length=1, max_length=80)]
Side = Literal["right", "left"]
Coordinates = tuple[Number, Number, Number]
MAX_JOINTS = 12  # [ours]
Joints = Annotated[list[Number], Field(min_length=1, max_length=MAX_JOINTS)]
Row4 = tuple[Number, Number, Number, Number]
Pose = tuple[Row4, Row4, Row4, Row4]
Twist = tuple[Number, Number, Number, Number, Number, Number]
Matrix6 = tuple[Twist, Twist, Twist, Twist, Twist, Twist]
FileName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\\]+$")]
MIN_FLANGE_MM = 10.0  # [ours] of the flange from the base: nearer is a pose in metres


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class AxesPart(_Part):
    """Targets on the flange, measured at several joint positions: `q` (N, n) and `targets_mm` (N, M, 3), MCS."""

    sd_mm: Positive
    q: Annotated[list[Joints], Field(max_length=500)]
    targets_mm: Annotated[list[Annotated[list[Coordinates], Field(max_length=50)]], Field(max_length=500)]


class FramePart(_Part):
    """Points of the frame, in CFCS and as measured in flange coordinates, mm."""

    sd_mm: Positive
    own_mm: Annotated[list[Coordinates], Field(max_length=500)]
    flange_mm: Annotated[list[Coordinates], Field(max_length=500)]


class WirePart(_Part):
    """The wire's tip at several feeds, flange coordinates, mm."""

    sd_mm: Positive
    feed_mm: Annotated[list[Number], Field(max_length=500)]
    tip_flange_mm: Annotated[list[Coordinates], Field(max_length=500)]


class MountPart(_Part):
    """`mount`: the file of a block's mount by images, beside the measurements."""

    mount: FileName


class SeenWirePart(_Part):
    """`plan`: a plan.json beside the measurements, from a point of the wire near the guide (entry) to its tip (end), on
    two images that show wire and frame on the flange. `feed_mm` as of WirePart, `sd_mm` its error."""

    plan: FileName
    feed_mm: Number
    sd_mm: Positive


class ModelPart(_Part):
    """An arm in an MJCF or URDF file beside the measurements; its flange's body, and the joint that feeds the wire."""

    model: FileName
    flange: Annotated[str, Field(min_length=1, max_length=200)]
    feed: Annotated[str | None, Field(max_length=200)] = None

    def manipulator(self, folder: Path) -> Manipulator:
        """Return the arm as designed. Raises UnusableInputError, SetUpError."""
        return read_arm(folder / self.model, self.flange, self.feed)


class PoseSdPart(_Part):
    """Errors of an arm's poses, 1 s.d. per axis: of the flange's origin, mm, and of its rotation, rad."""

    mm: Positive
    rad: Annotated[float, Field(gt=0, le=0.1)]

    @property
    def twist(self) -> np.ndarray:
        """(6,): s.d. of the flange's twist, flange coordinates."""
        return np.array([self.rad] * 3 + [self.mm] * 3)


class Measurements(_Part):
    """Measurements of one robot, the input of its calibration. `axes` None: the mount's images tell how well the arm's
    kinematics are known."""

    schema_: Annotated[Literal["sightline-robot-measurements/1"], Field(alias="schema")]
    robot_serial: Serial
    frame_serial: Serial
    side: Side
    arm: Design | ModelPart = "manipulator"
    measured_on: datetime
    axes: AxesPart | None = None
    frame: FramePart | MountPart
    wire: WirePart | SeenWirePart

    @staticmethod
    def read(file: Path) -> "Measurements":
        """Return the measurements in a file. Raises UnusableInputError."""
        return read_model(file, Measurements)


class MountedPart(BaseModel):
    """The frame of a mount's file."""

    serial: str | None
    fingerprint: str


class JointsPart(_Part):
    """Joints at an image, and where they put the flange by the model that its mount was found with."""

    q: Joints
    T_base_flange: Pose


class MountFile(BaseModel):
    """A block's mount by images, as `sightline robot calibrate --from-images` writes it, as far as a robot needs it.
    `joints`: at its last image; None where the poses of the flange were listed."""

    schema_: Annotated[Literal["sightline-mount/1"], Field(alias="schema")]
    robot_serial: Serial
    measured_on: datetime
    frame: MountedPart
    joints: JointsPart | None = None
    pose_sd: PoseSdPart
    T_flange_cfcs: Pose
    covariance: Matrix6

    @staticmethod
    def read(file: Path) -> "MountFile":
        """Return the mount in a file. Raises UnusableInputError."""
        return read_model(file, MountFile, "give the file of a mount")

    def axes(self, arm: Manipulator) -> CalibratedAxes:
        """Return the arm with its axes as stated. Raises RobotRefusedError for another arm than the images'."""
        if self.joints is not None:
            q, there = np.array(self.joints.q), _rigid("flange", self.joints.T_base_flange)
            if q.shape != (arm.count,) or not np.allclose(arm.T_mcs_flange(q).as_matrix(), there.as_matrix(), 0, 1e-6):
                raise RobotRefusedError(
                    "the mount was found with another arm, or another model of it: name the one that the list of "
                    "images names, or calibrate by images again"
                )
        # The stated error of a pose holds the play of its joints.
        known = replace(arm, backlash=0 * arm.backlash)
        return CalibratedAxes(known, np.zeros((6 * arm.arm_joints,) * 2), np.zeros(0))

    def mount(self, measured: Measurements) -> Mount:
        """Return the mount. Raises RobotRefusedError where it is another robot's or another frame's."""
        mounted = self.frame.serial
        if (self.robot_serial, mounted) != (measured.robot_serial, measured.frame_serial):
            raise RobotRefusedError(
                f"the mount is of frame {mounted!r} on robot {self.robot_serial!r}, the measurements are of frame "
                f"{measured.frame_serial!r} on robot {measured.robot_serial!r}"
            )
        return Mount(_rigid("block", self.T_flange_cfcs), _symmetric(np.array(self.covariance)), np.zeros(0))


class FlangePose(_Part):
    """Pose of the flange in the arm's base (4, 4), mm, at a time, and the covariance (6, 6) of its error, a twist in
    flange coordinates, rad and mm."""

    schema_: Annotated[Literal["sightline-flange-pose/1"], Field(alias="schema")]
    measured_on: datetime
    T_base_flange: Pose
    covariance: Matrix6

    @staticmethod
    def read(file: Path) -> "FlangePose":
        """Return the pose in a file. Raises UnusableInputError."""
        stated: FlangePose = read_model(file, FlangePose, "give the flange's pose")
        covariance = _symmetric(np.array(stated.covariance))
        if np.linalg.norm(stated.pose.translation) < MIN_FLANGE_MM:
            raise UnusableInputError(f"{file.name}: the flange is in its base: give its pose in mm, not in m")
        if not (np.linalg.eigvalsh(covariance)[0] > 0 and np.trace(covariance) < 3 * (10.0**2 + 0.1**2)):
            raise UnusableInputError(
                f"{file.name}: a pose's covariance is of its errors (rad, rad, rad, mm, mm, mm), all larger than 0 and "
                "of 0.1 rad and 10 mm at most"
            )
        return stated

    @property
    def pose(self) -> RigidTransform:
        """The pose. Raises UnusableInputError."""
        return _rigid("flange", self.T_base_flange)


class CapsulePart(_Part):
    """A `Capsule`."""

    name: Annotated[str, Field(max_length=80)]
    joints: Annotated[int, Field(ge=0, le=MAX_JOINTS)]
    ends_mm: tuple[Coordinates, Coordinates]
    radius_mm: Annotated[float, Field(allow_inf_nan=False, gt=0, le=1e4)]


class ManipulatorPart(_Part):
    """The fields of a `Manipulator`: joints from base to flange, poses (4, 4), values per joint in mm or rad.
    `column_stiffness` None: the base does not bend."""

    joints: Annotated[
        list[Annotated[str, Field(min_length=1, max_length=80)]], Field(min_length=1, max_length=MAX_JOINTS)
    ]
    axes: Annotated[list[Twist], Field(min_length=1, max_length=MAX_JOINTS)]
    has_feed: bool
    T_mcs_flange_home: Pose
    T_flange_cfcs: Pose
    T_flange_tool: Pose
    lower: Joints
    upper: Joints
    speed: Joints
    acceleration: Joints
    resolution: Joints
    backlash: Joints
    stiffness: Annotated[list[Annotated[float, Field(gt=0)]], Field(max_length=MAX_JOINTS)]
    column_stiffness: Annotated[float, Field(gt=0)] | None
    parts: Annotated[list[CapsulePart], Field(max_length=100)]
    guide_mm: Annotated[float, Field(ge=0, le=1e3)] = 0.0

    @staticmethod
    def of(manipulator: Manipulator) -> dict[str, Any]:
        """Return an arm's description as JSON values."""
        values = {field.name: getattr(manipulator, field.name) for field in fields(Manipulator)}
        for name, value in values.items():
            if isinstance(value, RigidTransform):
                values[name] = value.as_matrix().tolist()
            elif isinstance(value, np.ndarray):
                values[name] = value.tolist()
        parts = [{**vars(part), "ends_mm": np.asarray(part.ends_mm).tolist()} for part in manipulator.parts]
        stiff = manipulator.column_stiffness
        return {**values, "parts": parts, "column_stiffness": stiff if np.isfinite(stiff) else None}

    def manipulator(self) -> Manipulator:
        """Return the arm. Raises UnusableInputError."""
        values: dict[str, Any] = {name: np.array(value) for name, value in self if isinstance(value, list)}
        if any(len(value) != len(self.joints) for name, value in values.items() if name != "parts"):
            raise UnusableInputError("its joints, axes and limits differ in number")
        poses = (
            ("T_mcs_flange_home", "flange", self.T_mcs_flange_home),
            ("T_flange_cfcs", "frame on the flange", self.T_flange_cfcs),
            ("T_flange_tool", "wire on the flange", self.T_flange_tool),
        )
        values |= {name: _rigid(what, pose) for name, what, pose in poses}
        parts = tuple(Capsule(part.name, part.joints, np.array(part.ends_mm), part.radius_mm) for part in self.parts)
        values |= {"joints": tuple(self.joints), "has_feed": self.has_feed, "parts": parts, "guide_mm": self.guide_mm}
        return Manipulator(**values, column_stiffness=self.column_stiffness or np.inf)


class ImagePart(_Part):
    """Joints at an image, the time of their reading in s since 1970, and the hash of the image's file. `stated`: as of
    `PoseAtImage`."""

    q: Joints
    stated: Matrix6 | None = None
    read_s: Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e11)]
    source: Annotated[str, Field(max_length=200)] = ""


class WireSeenPart(_Part):
    """A point of the wire and its tip (2, 3) as both images show them, CFCS mm, with their covariance (6, 6)."""

    wire_mm: tuple[Coordinates, Coordinates]
    covariance_mm2: Matrix6


class RobotFile(_Part):
    """A calibrated robot as stored. `covariance` and errors as in `CalibratedRobot`; `images`: its joints, by view. Of
    version 1, which knew the manipulator alone, what is missing is as designed. `by_pose`: the images of its block were
    taken at poses of its flange, not at joints, and so must be those of a plan.

    `frame`: fingerprint of the file of the frame whose mount was measured, "" if it was not stated. `wire_seen`: the
    wire in those images, which corrects the mounts of frame and wire for plans made on them; None: encoders alone.
    """

    schema_: Annotated[Literal["sightline-robot/2"], Field(alias="schema")] = "sightline-robot/2"
    robot_serial: Serial
    frame_serial: Serial
    frame: Annotated[str, Field(max_length=200)] = ""
    side: Side
    measured_on: datetime
    manipulator: ManipulatorPart
    covariance: Annotated[list[Annotated[list[Number], Field(max_length=100)]], Field(max_length=100)]
    compliance_sd: Twist
    pose_sd: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    by_pose: bool = False
    images: dict[Literal["pa", "lateral"], ImagePart] = {}
    wire_seen: WireSeenPart | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_version_1(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("schema") != "sightline-robot/1":
            return data
        side, part = data.get("side"), data.get("manipulator")
        known = ManipulatorPart.of(nominal_manipulator(side)) if side in ("right", "left") else {}
        return {**data, "schema": "sightline-robot/2", "manipulator": known | part if isinstance(part, dict) else part}

    @staticmethod
    def calibrated(
        measurements: Measurements, folder: Path = Path(), seen: "tuple[np.ndarray, np.ndarray] | None" = None
    ) -> "tuple[RobotFile, dict[str, float]]":
        """Return the robot from its measurements, and the rms residual of each that a tracker made, mm. `folder`: of
        the file of measurements, for the files that it names. `seen`: the points (2, 3) and their covariance (6, 6), mm
        and mm², CFCS, of the plan that it names for the wire.

        Raises UnusableInputError, and RobotRefusedError for measurements that contradict each other."""
        arm, more = arm_of(measurements.arm, measurements.side, folder), {}
        measured_axes, balls = measurements.axes, measurements.frame
        if measured_axes is None and isinstance(balls, MountPart):
            mounted = MountFile.read(folder / balls.mount)
            axes, frame = mounted.axes(arm), mounted.mount(measurements)
            more = {
                "frame": mounted.frame.fingerprint,
                "measured_on": min(measurements.measured_on, mounted.measured_on, key=_utc),
                "pose_sd": mounted.pose_sd.twist.tolist(),
                "by_pose": mounted.joints is None,
            }
        elif measured_axes is not None and isinstance(balls, FramePart):
            axes = calibrate_axes(arm, even(measured_axes.q), even(measured_axes.targets_mm), measured_axes.sd_mm)
            frame = measured_mount(np.array(balls.own_mm), np.array(balls.flange_mm), balls.sd_mm)
        else:
            raise UnusableInputError(
                "give axes and balls of the frame, both measured by a tracker, or the frame's mount by images and no "
                "axes: images locate a block on the flange of the arm's own kinematics"
            )
        wire = _wire(measurements.wire, seen)
        robot = CalibratedRobot.of(axes, frame, wire, on_frame=seen is not None)
        file = RobotFile.model_validate(
            {
                "robot_serial": measurements.robot_serial,
                "frame_serial": measurements.frame_serial,
                "side": measurements.side,
                "measured_on": measurements.measured_on,
                "manipulator": ManipulatorPart.of(robot.manipulator),
                "covariance": robot.covariance.tolist(),
                "compliance_sd": robot.compliance_sd.tolist(),
                "schema": "sightline-robot/2",
                **more,
            }
        )
        parts: dict[str, CalibratedAxes | Mount] = {"axes": axes, "frame": frame, "wire": wire}
        sized = {name: part.residual_mm for name, part in parts.items() if part.residual_mm.size}
        return file, {name: float(np.sqrt(np.mean(residual**2))) for name, residual in sized.items()}

    @staticmethod
    def read(file: Path) -> "RobotFile":
        """Return the robot in a file. Raises UnusableInputError for a file that is not a valid robot."""
        robot_file = read_model(file, RobotFile)
        try:
            robot_file.robot()
        except UnusableInputError as error:
            raise UnusableInputError(f"{file.name}: {error}; calibrate the robot again") from error
        return robot_file

    def write(self, file: Path) -> None:
        """Write the file atomically."""
        write_whole(file, self.model_dump_json(by_alias=True, indent=1).encode())

    def robot(self) -> CalibratedRobot:
        """Return the calibrated robot. Raises UnusableInputError."""
        covariance, unseen = _symmetric(even(self.covariance)), np.array(self.compliance_sd)
        return CalibratedRobot(self.manipulator.manipulator(), covariance, unseen, np.array(self.pose_sd))

    def of_frame(self, serial: str | None, fingerprint: str) -> "RobotFile":
        """Return the robot's file with the fingerprint of its frame's file, whose serial must be the measured one.

        Raises RobotRefusedError."""
        if serial != self.frame_serial:
            raise RobotRefusedError(
                f"the frame file states the serial {serial!r}, the measurements state {self.frame_serial!r}; give the "
                "file of the frame that was measured on the flange"
            )
        if self.frame not in ("", fingerprint):
            raise RobotRefusedError(
                f"the frame file is {fingerprint}, the block's mount was found with {self.frame}: give the same file"
            )
        return self.model_copy(update={"frame": fingerprint})

    def refuse_old(self, now_s: float) -> None:
        """Raise RobotRefusedError if the calibration is too old, or dated in the future."""
        age = datetime.fromtimestamp(now_s, UTC) - _utc(self.measured_on)
        if not timedelta(0) <= age <= timedelta(days=CALIBRATION_DAYS):
            raise RobotRefusedError(
                f"the robot was calibrated on {self.measured_on:%Y-%m-%d}: {age.days} days ago (0 to "
                f"{CALIBRATION_DAYS} are accepted); check the clock, or calibrate it again"
            )

    def refuse_moved(self, before: np.ndarray, after: np.ndarray) -> None:
        """Raise RobotRefusedError if the robot moved between two readings of its joints."""
        register(self.robot(), {"one": PoseAtImage(before, 0.0, 0.0), "other": PoseAtImage(after, 0.0, 0.0)})

    def at_image(
        self, view: Literal["pa", "lateral"], q: np.ndarray | FlangePose, now_s: float, source: str
    ) -> "RobotFile":
        """Return the file with the joints at an image taken just now, or with those at which the flange has its pose.
        `source`: hash of the image's file, as the plan will name it.

        Images on which a plan would have expired are dropped. So are images dated in the future: the clock was set back
        since, so their age is unknown. Raises RobotRefusedError for impossible joints, and for a robot that moved since
        the other image."""
        if self.by_pose != isinstance(q, FlangePose):
            found, now = ("poses", "--pose") if self.by_pose else ("joints", "the robot's address")
            raise RobotRefusedError(
                f"the robot was calibrated at {found} of its arm, whose flange may be another at the other: register "
                f"it by {now}"
            )
        stated = None
        if isinstance(q, FlangePose):
            q, stated = self._joints_at(view, q), q.covariance
        count = len(self.manipulator.joints)
        if q.shape != (count,) or not np.isfinite(q).all():
            raise UnusableInputError(
                f"the robot's pose at an image needs {count} finite joint positions: docs/robot.md"
            )
        kept = {
            name: image
            for name, image in self.images.items()
            if 0.0 <= now_s - image.read_s < LIFETIME_S and name != view
        }
        image = ImagePart(q=q.tolist(), read_s=now_s, source=source, stated=stated)
        updated = self.model_copy(update={"images": {**kept, view: image}, "wire_seen": None})
        updated._registration()
        return updated

    def _joints_at(self, view: str, stated: FlangePose) -> np.ndarray:
        """Return joints (n,) that put the flange at a pose, near those at the other image."""
        arm = self.manipulator.manipulator()
        near = [np.array(image.q) for name, image in self.images.items() if name != view]
        return arm.inverse_pose(stated.pose * arm.T_flange_tool, *near)

    def with_wire_seen(self, wire_mm: np.ndarray, covariance_mm2: np.ndarray) -> "RobotFile":
        """Return the file with the wire (2, 3) that both registered images show; see
        `CalibratedRobot.with_wire_seen`. It replaces an earlier one of these images.

        Raises UnusableInputError, RobotRefusedError."""
        seen = WireSeenPart.model_validate({"wire_mm": wire_mm.tolist(), "covariance_mm2": covariance_mm2.tolist()})
        updated = self.model_copy(update={"wire_seen": seen})
        updated.registration()
        return updated

    def registration(self) -> Registration:
        """Return the frame's registration at both images. Raises RobotRefusedError."""
        missing = [view for view in VIEWS if view not in self.images]
        if missing:
            raise RobotRefusedError(
                f"run `sightline robot register`: the robot's pose at the {' and '.join(missing)} image is missing"
            )
        return self._registration()

    def _registration(self) -> Registration:
        """Return the registration from the images present."""
        poses = {
            str(view): PoseAtImage(
                np.array(image.q), image.read_s, image.read_s, None if image.stated is None else np.array(image.stated)
            )
            for view, image in self.images.items()
        }
        stood, seen = register(self.robot(), poses), self.wire_seen
        if seen is None:
            return stood
        robot = stood.robot.with_wire_seen(stood.q, np.array(seen.wire_mm), np.array(seen.covariance_mm2))
        return register(robot, poses)

    def refuse_other_images(self, images: Mapping[str, str]) -> None:
        """Raise RobotRefusedError unless a plan was made on the registered images. `images`: hash of the image file, by
        view."""
        for view, registered in self.images.items():
            if not registered.source or images.get(view) != registered.source:
                raise RobotRefusedError(
                    f"the plan's {view} image is {images.get(view) or 'not named'}, the one registered is "
                    f"{registered.source or 'not named'}: the robot's pose at the plan's images is unknown; plan on "
                    "the registered images, or take and register new ones"
                )

    def refuse_other(self, side: str | None, frame_serial: str | None, frame: str, now_s: float) -> None:
        """Raise RobotRefusedError if a plan's side or frame differs from this robot's, or its calibration is too old.

        `frame`: fingerprint of the plan's frame file, "" if it states none. Two frames of one serial, or one frame
        measured twice, have two coordinate systems.
        """
        self.refuse_old(now_s)
        for what, planned, here in (("side", side, self.side), ("frame serial", frame_serial, self.frame_serial)):
            if planned != here:
                raise RobotRefusedError(
                    f"the plan's {what} is {planned!r}, the robot's file is for {here!r}: it is another patient's "
                    "plan, or another frame; find out which before anything else"
                )
        if frame != self.frame:
            raise RobotRefusedError(
                f"the plan's frame file is {frame or 'not stated'}, the robot was calibrated with "
                f"{self.frame or 'a frame file that it does not state'}: their coordinates differ; plan with the file "
                "that the robot was calibrated with (`sightline robot calibrate --frame FILE`). A frame that was fixed "
                "to the patient at the plan's images registers no robot: its encoders tell where its flange is"
            )


def read_model(file: Path, model: type[Any], advice: str = "give a robot's own file") -> Any:
    """Return the `model` in a JSON file. Raises UnusableInputError."""
    try:
        data = read_bounded(file, MAX_TEXT_BYTES, UnusableInputError, advice)
        return model.model_validate(loads(data))
    except ValidationError as error:
        first = max(error.errors(), key=lambda one: len(one["loc"]))  # of alternatives the one that was meant
        where = ".".join(map(str, first["loc"]))
        raise UnusableInputError(f"{file.name}: {where}: {first['msg']}") from None
    except (JSONDecodeError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise UnusableInputError(f"{file.name} is not JSON: {str(error)[:200]}") from None


def arm_of(arm: Design | ModelPart, side: str, folder: Path) -> Manipulator:
    """Return an arm as designed; `folder`: of its model. Raises UnusableInputError, SetUpError."""
    return arm.manipulator(folder) if isinstance(arm, ModelPart) else DESIGNS[arm](side)


def _wire(part: WirePart | SeenWirePart, seen: tuple[np.ndarray, np.ndarray] | None) -> Mount:
    """Return the wire on the flange as measured, or on the frame as images show it."""
    if isinstance(part, WirePart):
        return measured_axis(np.array(part.feed_mm), np.array(part.tip_flange_mm), part.sd_mm)
    if seen is None:
        raise UnusableInputError(f"the wire's points are in {part.plan}: read it")
    return seen_axis(*seen, part.feed_mm, part.sd_mm)


def _utc(time: datetime) -> datetime:
    return time.astimezone(UTC)  # without a zone it is local time


def _symmetric(covariance: np.ndarray) -> np.ndarray:
    if covariance.shape != covariance.shape[::-1] or not np.allclose(covariance, covariance.T, rtol=1e-9, atol=1e-15):
        raise UnusableInputError("its covariance is not symmetric")
    return covariance


def even(rows: list[list[Any]]) -> np.ndarray:
    """Return joints, or targets, of N positions as an array (N, ...). Raises UnusableInputError."""
    if len({len(row) for row in rows}) != 1:
        raise UnusableInputError("every position needs the same joints, with the same targets measured")
    return np.array(rows)


def _rigid(name: str, rows: Iterable[Iterable[float]]) -> RigidTransform:
    matrix = np.array([list(row) for row in rows])
    fault = why_not_rigid(matrix)
    if fault is not None:
        raise UnusableInputError(f"the pose of its {name} is not a rigid motion: {fault}")
    return RigidTransform.from_matrix(matrix)
