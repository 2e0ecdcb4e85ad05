"""Registration of CFCS to MCS: the frame's pose at each image, from the robot that holds it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError, UnusableInputError
from sightline.robot.kinematics.calibrated import CalibratedRobot

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

    Raises UnusableInputError for poses that are not finite; RobotRefusedError for a pose that is stale or beyond the
    joint limits, and for a robot that moved between the images.
    """
    if not poses:
        raise UnusableInputError("a registration needs the robot's pose at each image")
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
    times = np.array([pose.read_s, pose.imaged_s])
    if np.shape(pose.q) != (5,) or not np.isfinite(pose.q).all() or not np.isfinite(times).all():
        raise UnusableInputError(
            f"the robot's pose at the {view} image needs five finite joint positions and two times"
        )
    if abs(pose.read_s - pose.imaged_s) > FRESH_S:
        raise RobotRefusedError(
            f"the robot's pose was read {abs(pose.read_s - pose.imaged_s):.2f} s from the {view} image (at most "
            f"{FRESH_S:g} s); check that robot and images share a clock, and take the image again"
        )
    if robot.manipulator.beyond_limits(pose.q).any():
        raise RobotRefusedError(
            f"the joints at the {view} image lie beyond the manipulator's limits: another robot's calibration, or "
            "encoders that were never homed; home the robot and take the images again"
        )


def _refuse_moved(view: str, moved: RigidTransform) -> None:
    shift, rotation = np.linalg.norm(moved.translation), moved.rotation.magnitude()
    if shift > STILL_MM or rotation > STILL_RAD:
        raise RobotRefusedError(
            f"the robot moved between the images: at the {view} image the frame stood {shift:.2f} mm and "
            f"{np.rad2deg(rotation):.3f}° from its mean place (at most {STILL_MM:g} mm and "
            f"{np.rad2deg(STILL_RAD):.2f}°); hold it still and take both images again"
        )
