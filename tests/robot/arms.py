"""Arms of six and seven axes for tests."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.robot.kinematics.calibrated import MACHINED_SD, CalibratedAxes, CalibratedRobot, Mount
from sightline.robot.kinematics.designs import seven_axis, six_axis
from sightline.robot.kinematics.manipulator import Manipulator

SIX, SEVEN = six_axis(), seven_axis()
AT_IMAGES = RigidTransform.from_components([560.0, 40.0, 170.0], Rotation.from_rotvec([0.0, 0.0, np.pi]))


def at_images(arm: Manipulator) -> np.ndarray:
    """Joints with the frame upright, its hip ahead of the base."""
    return arm.inverse_pose(AT_IMAGES * arm.T_flange_cfcs.inv() * arm.T_flange_tool)


def calibrated(arm: Manipulator) -> CalibratedRobot:
    """The arm with the errors of a good calibration."""
    sd = np.tile(0.1 * MACHINED_SD, arm.arm_joints)
    frame, guide = (Mount(pose, 1e-4 * np.eye(6), np.zeros(0)) for pose in (arm.T_flange_cfcs, arm.T_flange_tool))
    return CalibratedRobot.of(CalibratedAxes(arm, np.diag(sd**2), np.zeros((0, 0))), frame, guide)


def longer(arm: Manipulator) -> Manipulator:
    """The arm with its upper arm 5 mm longer, which lies along -x at home as that of SIX."""
    beyond = np.tile([0.0, 0.0, 0.0, -5.0, 0.0, 0.0], (arm.count - 1, 1))
    return arm.displaced(np.concatenate([np.zeros((2, 6)), beyond]))


def as_mjcf(arm: Manipulator) -> str:
    """The arm's rotary axes as an MJCF file whose bodies all lie at the world's origin."""
    home = arm.T_mcs_flange_home
    quat = row(home.rotation.as_quat(scalar_first=True))
    body = f'<body name="flange" pos="{row(home.translation / 1e3)}" quat="{quat}"/>'
    for joint in reversed(range(arm.count)):
        axis, moment = arm.axes[joint, :3], arm.axes[joint, 3:]
        limits = row([arm.lower[joint], arm.upper[joint]])
        place = f'axis="{row(axis)}" pos="{row(np.cross(axis, moment) / 1e3)}"'
        own = f'<joint name="axis-{joint}" {place} range="{limits}" limited="true"/>'
        body = f'<body>{own}<geom type="sphere" size="0.05"/>{body}</body>'
    return f'<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody></mujoco>'


def row(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values))
