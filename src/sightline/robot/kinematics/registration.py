"""Registration of CFCS to MCS: the frame's pose at each image, from the joints of the robot that holds it.

`T_mcs_cfcs` maps points from CFCS to MCS. The link's CLB_ message carries its inverse.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.calibrated import CalibratedRobot
from sightline.robot.kinematics.manipulator import JOINTS, describe_excess

# The frame must not move between the images. A larger difference in its origin or direction than this is a movement,
# not the encoders' resolution [ours].
STILL_MM = 0.05
STILL_RAD = float(np.deg2rad(0.02))
# Largest time between an image and the reading of its pose [ours].
FRESH_S = 0.2


@dataclass(frozen=True, eq=False)
class PoseAtImage:
    """Encoder readings for one image: joints `q` (5,) read at `read_s`, image acquired at `imaged_s`, in seconds of the
    same clock."""

    q: np.ndarray
    read_s: float
    imaged_s: float


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of the frame at the images. `T_mcs_cfcs`: from the mean joints `q` (5,) of all images, which hardly differ;
    `of_view`: from each view's own joints; `imaged_s`: time of the last image."""

    robot: CalibratedRobot
    q: np.ndarray
    T_mcs_cfcs: RigidTransform
    of_view: dict[str, RigidTransform]
    imaged_s: float


def register(robot: CalibratedRobot, poses: Mapping[str, PoseAtImage]) -> Registration:
    """Return the registration from the pose at each image, by view.

    Raises UnusableInputError without poses, and for a pose without five finite joint values or with a time that is not
    finite; RobotRefusedError for a pose that is stale or beyond the joint limits, and for a robot that moved between
    the images.
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
        _refuse_moved(view, (middle.inv() * pose))
    return Registration(robot, q, middle, of_view, max(pose.imaged_s for pose in poses.values()))


def _refuse_unusable(robot: CalibratedRobot, view: str, pose: PoseAtImage) -> None:
    finite, age_s = int(np.isfinite(pose.q).sum()), abs(pose.read_s - pose.imaged_s)
    if np.shape(pose.q) != (len(JOINTS),) or finite < len(JOINTS):
        raise UnusableInputError(
            f"acquire the images again with the robot connected: the pose at the {view} image has {finite} finite "
            f"joint values ({len(JOINTS)} needed)"
        )
    if not np.isfinite(age_s):
        raise UnusableInputError(f"acquire the {view} image again: its time or the time of its pose is not finite")
    if age_s > FRESH_S:
        raise RobotRefusedError(
            f"check that robot and images share a clock, and acquire the {view} image again: the robot's pose was read "
            f"{age_s:.2f} s from it (at most {FRESH_S:g} s)"
        )
    beyond = robot.manipulator.beyond_limits(pose.q)
    if beyond.any():
        joints = [describe_excess(j, pose.q[j], beyond[j], "is at") for j in np.flatnonzero(beyond).tolist()]
        raise RobotRefusedError(
            "load this robot's calibration, or home the robot; then acquire both images again: at the "
            f"{view} image {'; '.join(joints)}"
        )


def _refuse_moved(view: str, moved: RigidTransform) -> None:
    shift, rotation = np.linalg.norm(moved.translation), moved.rotation.magnitude()
    if shift > STILL_MM or rotation > STILL_RAD:
        raise RobotRefusedError(
            "hold the robot still and acquire both images again: it moved between the images. At the "
            f"{view} image the frame was {shift:.2f} mm and {np.rad2deg(rotation):.3f}° from its mean pose (at most "
            f"{STILL_MM:g} mm and {np.rad2deg(STILL_RAD):.2f}°)"
        )
