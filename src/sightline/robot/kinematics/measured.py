"""The robot's file: its calibration, its identity, and its pose at the images."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
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


class ModelPart(_Part):
    """An arm in an MJCF or URDF file beside the measurements; its flange's body, and the joint that feeds the wire."""

    model: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\\]+$")]
    flange: Annotated[str, Field(min_length=1, max_length=200)]
    feed: Annotated[str | None, Field(max_length=200)] = None


class Measurements(_Part):
    """Measurements of one robot, the input of its calibration."""

    schema_: Annotated[Literal["sightline-robot-measurements/1"], Field(alias="schema")]
    robot_serial: Serial
    frame_serial: Serial
    side: Side
    arm: Design | ModelPart = "manipulator"
    measured_on: datetime
    axes: AxesPart
    frame: FramePart
    wire: WirePart

    @staticmethod
    def read(file: Path) -> "Measurements":
        """Return the measurements in a file. Raises UnusableInputError."""
        return read_model(file, Measurements)


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
    """Joints at an image, the time of their reading in s since 1970, and the hash of the image's file."""

    q: Joints
    read_s: Annotated[float, Field(allow_inf_nan=False, ge=0, le=1e11)]
    source: Annotated[str, Field(max_length=200)] = ""


class WireSeenPart(_Part):
    """A point of the wire and its tip (2, 3) as both images show them, CFCS mm, with their covariance (6, 6)."""

    wire_mm: tuple[Coordinates, Coordinates]
    covariance_mm2: tuple[Twist, Twist, Twist, Twist, Twist, Twist]


class RobotFile(_Part):
    """A calibrated robot as stored. `covariance` as in `CalibratedRobot`; `images`: its joints, by view. Of version 1,
    which knew the manipulator alone, what is missing is as designed.

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
    def calibrated(measurements: Measurements, folder: Path = Path()) -> "tuple[RobotFile, dict[str, float]]":
        """Return the robot from its measurements, and the rms residual of each calibration, mm. `folder`: of the file
        of measurements, for an arm from a model file.

        Raises UnusableInputError, and RobotRefusedError for measurements that contradict each other."""
        axes = calibrate_axes(
            _arm(measurements, folder),
            _even(measurements.axes.q),
            _even(measurements.axes.targets_mm),
            measurements.axes.sd_mm,
        )
        frame = measured_mount(
            np.array(measurements.frame.own_mm), np.array(measurements.frame.flange_mm), measurements.frame.sd_mm
        )
        wire = measured_axis(
            np.array(measurements.wire.feed_mm), np.array(measurements.wire.tip_flange_mm), measurements.wire.sd_mm
        )
        robot = CalibratedRobot.of(axes, frame, wire)
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
            }
        )
        return file, {"axes": _rms(axes), "frame": _rms(frame), "wire": _rms(wire)}

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
        covariance = _even(self.covariance)
        if covariance.shape != covariance.shape[::-1] or not np.allclose(
            covariance, covariance.T, rtol=1e-9, atol=1e-15
        ):
            raise UnusableInputError("its covariance is not symmetric")
        return CalibratedRobot(self.manipulator.manipulator(), covariance, np.array(self.compliance_sd))

    def of_frame(self, serial: str | None, fingerprint: str) -> "RobotFile":
        """Return the robot's file with the fingerprint of its frame's file, whose serial must be the measured one.

        Raises RobotRefusedError."""
        if serial != self.frame_serial:
            raise RobotRefusedError(
                f"the frame file states the serial {serial!r}, the measurements state {self.frame_serial!r}; give the "
                "file of the frame that was measured on the flange"
            )
        return self.model_copy(update={"frame": fingerprint})

    def refuse_old(self, now_s: float) -> None:
        """Raise RobotRefusedError if the calibration is too old, or dated in the future."""
        now = datetime.fromtimestamp(now_s, UTC)
        age = now - self.measured_on.astimezone(UTC)  # without a zone it is local time
        if not timedelta(0) <= age <= timedelta(days=CALIBRATION_DAYS):
            raise RobotRefusedError(
                f"the robot was calibrated on {self.measured_on:%Y-%m-%d}: {age.days} days ago (0 to "
                f"{CALIBRATION_DAYS} are accepted); check the clock, or calibrate it again"
            )

    def refuse_moved(self, before: np.ndarray, after: np.ndarray) -> None:
        """Raise RobotRefusedError if the robot moved between two readings of its joints."""
        register(self.robot(), {"one": PoseAtImage(before, 0.0, 0.0), "other": PoseAtImage(after, 0.0, 0.0)})

    def at_image(self, view: Literal["pa", "lateral"], q: np.ndarray, now_s: float, source: str) -> "RobotFile":
        """Return the file with the joints at an image taken just now. `source`: hash of the image's file, as the plan
        will name it.

        Images on which a plan would have expired are dropped. So are images dated in the future: the clock was set back
        since, so their age is unknown. Raises RobotRefusedError for impossible joints, and for a robot that moved since
        the other image."""
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
        image = ImagePart(q=q.tolist(), read_s=now_s, source=source)
        updated = self.model_copy(update={"images": {**kept, view: image}, "wire_seen": None})
        updated._registration()
        return updated

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
            str(view): PoseAtImage(np.array(image.q), image.read_s, image.read_s) for view, image in self.images.items()
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


def _arm(measurements: Measurements, folder: Path) -> Manipulator:
    """Return the arm as designed."""
    arm = measurements.arm
    if isinstance(arm, ModelPart):
        return read_arm(folder / arm.model, arm.flange, arm.feed)
    return DESIGNS[arm](measurements.side)


def _even(rows: list[list[Any]]) -> np.ndarray:
    if len({len(row) for row in rows}) != 1:
        raise UnusableInputError("every position needs the same joints, with the same targets measured")
    return np.array(rows)


def _rigid(name: str, rows: Iterable[Iterable[float]]) -> RigidTransform:
    matrix = np.array([list(row) for row in rows])
    fault = why_not_rigid(matrix)
    if fault is not None:
        raise UnusableInputError(f"the pose of its {name} is not a rigid motion: {fault}")
    return RigidTransform.from_matrix(matrix)


def _rms(calibration: CalibratedAxes | Mount) -> float:
    return float(np.sqrt(np.mean(calibration.residual_mm**2)))
