"""A block on the flange of an arm, from images of a C-arm at rest: the list of the images, and the mount."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration import CArm
from sightline.calibration.solids.held import MIN_IMAGES, HeldCalibration, calibrate_held
from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.rigid import displacement, why_not_rigid
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, RefusedError, UnusableInputError
from sightline.frame import Frame
from sightline.frame.designs import FRAME_NAMES
from sightline.from_images.pipeline import find_beads, known_arm, label_beads
from sightline.imaging import read_image
from sightline.robot.kinematics.by_images import refuse_alike
from sightline.robot.kinematics.calibrated import Mount
from sightline.robot.kinematics.designs import Design
from sightline.robot.kinematics.measured import Joints, ModelPart, Pose, PoseSdPart, Serial, arm_of, even, read_model

MAX_IMAGES = 60  # [ours] 15 are proposed

Name = Annotated[str, Field(min_length=1, max_length=200)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ArmImagePart(_Part):
    """An image, its `file` beside the list, and the arm's joints at it, or the flange's pose in its base (4, 4), mm."""

    file: Name
    q: Joints | None = None
    T_base_flange: Pose | None = None


class ArmImages(_Part):
    """Images of a block on an arm's flange. `frame`: the block, a built-in one or a file beside the list; `arm`: the
    one whose joints are listed, None where poses are."""

    schema_: Annotated[Literal["sightline-arm-images/1"], Field(alias="schema")]
    robot_serial: Serial
    frame: Name
    arm: Design | ModelPart | None = None
    measured_on: datetime
    pose_sd: PoseSdPart
    images: Annotated[list[ArmImagePart], Field(min_length=MIN_IMAGES, max_length=MAX_IMAGES)]

    @staticmethod
    def read(file: Path) -> "ArmImages":
        """Return the list in a file. Raises UnusableInputError."""
        listed: ArmImages = read_model(file, ArmImages, "give a list of images and poses")
        for image in listed.images:
            if (image.q is None) != (listed.arm is None) or (image.T_base_flange is None) == (listed.arm is None):
                raise UnusableInputError(
                    f"{file.name}: {image.file}: give q of each image and the arm, or T_base_flange of each and no arm"
                )
            if image.T_base_flange and (why := why_not_rigid(np.array(image.T_base_flange))):
                raise UnusableInputError(f"{file.name}: the pose of {image.file} is not a rigid motion: {why}")
        if len({image.file for image in listed.images}) < len(listed.images):
            raise UnusableInputError(f"{file.name} lists an image twice; each pose has an image of its own")
        return listed

    def frame_in(self, folder: Path) -> Frame:
        """Return the block. Raises FrameError."""
        return Frame.load(self.frame if self.frame in FRAME_NAMES else folder / self.frame)

    def poses_in(self, folder: Path) -> RigidTransform:
        """Return the poses (N) of the flange in the base. Raises UnusableInputError, RobotRefusedError."""
        if self.arm is None:
            return RigidTransform.from_matrix(np.array([image.T_base_flange for image in self.images]))
        arm, q = arm_of(self.arm, "right", folder), even([image.q or [] for image in self.images])
        poses = arm.T_mcs_flange(q)
        arm.refuse_misread(q, [image.file for image in self.images])
        return poses


@dataclass(frozen=True, eq=False)
class ArmCalibration:
    """The block on the flange, by images. `mount.residual_mm`: how far each image used deviates from the others.

    `unseen`: images whose balls could not be found or labelled, with the reason; `held`: the adjustment, with the
    images that contradict the others.
    """

    mount: Mount
    frame: Frame
    unseen: dict[str, str]
    held: HeldCalibration

    @property
    def T_base_camera(self) -> RigidTransform:
        """The C-arm in the base: x along the image's rows (against them where it is mirrored), z along the beam."""
        camera, origin = self.held.fit.at.camera, self.held.fit.held.origin_mm
        to_camera = RigidTransform.from_components(camera.translation_mm, Rotation.from_matrix(camera.rotation))
        return RigidTransform.from_translation(origin) * to_camera.inv()

    @property
    def error_95(self) -> tuple[float, float]:
        """The 95 % errors of the block's middle, mm, and of its rotation, rad."""
        move, covariance = displacement(self.mount.pose.translation), self.mount.covariance
        return float(length_quantile(move @ covariance @ move.T)), float(length_quantile(covariance[:3, :3]))

    def document(self, listed: ArmImages, folder: Path) -> dict[str, Any]:
        """Return the mount as JSON types. `covariance` (6, 6): as of `Mount`, rad and mm; `folder`: of the list."""
        camera, place = self.held.fit.at.camera, self.error_95
        last, poses = listed.images[-1], listed.poses_in(folder)
        return {
            "schema": "sightline-mount/1",
            "robot_serial": listed.robot_serial,
            "measured_on": listed.measured_on.isoformat(),
            "frame": {"name": self.frame.name, "serial": self.frame.serial, "fingerprint": self.frame.fingerprint},
            "pose_sd": listed.pose_sd.model_dump(),
            "joints": None if last.q is None else {"q": last.q, "T_base_flange": poses[-1].as_matrix().tolist()},
            "T_flange_cfcs": self.mount.pose.as_matrix().tolist(),
            "covariance": self.mount.covariance.tolist(),
            "error_95": {"middle_mm": place[0], "rotation_deg": float(np.degrees(place[1]))},
            "c_arm": {
                "T_base_camera": self.T_base_camera.as_matrix().tolist(),
                "focal_px": camera.focal_px,
                "centre_px": camera.centre_px.tolist(),
                "mirrored": camera.mirrored,
            },
            "images": {
                name: {
                    "used": name not in self.held.bad,
                    "shift_mm": off.shift_mm,
                    "rotation_deg": float(np.degrees(off.rotation)),
                }
                for name, off in self.held.deviations().items()
            },
            "unseen": self.unseen,
            "balls_left_out": self.held.balls,
        }


def calibrate_on_arm(listed: ArmImages, folder: Path, frame: Frame) -> ArmCalibration:
    """Return where the block is on the flange, from listed images in a folder.

    Raises ImageError, UnusableInputError, RefusedError.
    """
    poses = listed.poses_in(folder)
    seen: list[Observations] = []
    at: list[int] = []
    unseen: dict[str, str] = {}
    arms: set[CArm | None] = set()
    for k, listing in enumerate(listed.images):
        image = read_image(folder / listing.file)
        try:
            image, beads = find_beads(image)
            seen.append(label_beads(image, beads, frame, listing.file))
            at.append(k)
            arms.add(known_arm(image))
        except RefusedError as refused:
            unseen[listing.file] = str(refused)
    if len(arms) > 1:
        raise UnusableInputError("the images state different distances or pixels: they are not of one C-arm at rest")
    if len(seen) < MIN_IMAGES:
        name, why = next(iter(unseen.items()))
        raise CalibrationRefusedError(
            f"{len(seen)} of {len(listed.images)} images show the block ({MIN_IMAGES} are needed); {name}: {why}"
        )
    return calibrated_on_arm(seen, frame, poses[np.array(at)], listed.pose_sd.twist, arms.pop(), unseen)


def calibrated_on_arm(  # noqa: PLR0917
    seen: list[Observations],
    frame: Frame,
    poses: RigidTransform,
    sd: np.ndarray,
    c_arm: CArm | None,
    unseen: dict[str, str] | None = None,
) -> ArmCalibration:
    """Return where the block is on the flange, from its labelled balls; arguments as of `calibrate_held`.

    Raises what `calibrate_held` and `refuse_alike` raise.
    """
    refuse_alike(poses)
    held = calibrate_held(seen, frame, poses, sd, c_arm)
    refuse_alike(held.fit.held.poses)
    off = held.deviations()
    shift_mm = np.array([off[name].shift_mm for name in held.names])
    return ArmCalibration(Mount(*held.fit.mount(), shift_mm), frame, unseen or {}, held)
