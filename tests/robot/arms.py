"""Arms of six and seven axes for tests, and bad ones with a controller of their own."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation
from tests.robot.rig import SETUP

from sightline.errors import RobotRefusedError
from sightline.robot.arms.adapter import JointTrajectory, SimulatedArm
from sightline.robot.arms.streamed import StreamedArm
from sightline.robot.kinematics.calibrated import MACHINED_SD, CalibratedAxes, CalibratedRobot, Mount
from sightline.robot.kinematics.designs import seven_axis, six_axis
from sightline.robot.kinematics.manipulator import Manipulator
from sightline.robot.kinematics.measured import ManipulatorPart, RobotFile
from sightline.robot.plant import PlantFlag, Reading

SIX, SEVEN = six_axis(), seven_axis()
AT_IMAGES = RigidTransform.from_components([560.0, 40.0, 170.0], Rotation.from_rotvec([0.0, 0.0, np.pi]))

ARM_SETUP = replace(SETUP, frame_mounted=False, c_arm_away=True)


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


def robot_file(arm: Manipulator) -> RobotFile:
    """The file of that arm, calibrated now, for a frame SN-7 on the right."""
    robot = calibrated(arm)
    return RobotFile.model_validate(
        {
            "schema": "sightline-robot/2",
            "robot_serial": "R-1",
            "frame_serial": "SN-7",
            "side": "right",
            "measured_on": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "manipulator": ManipulatorPart.of(robot.manipulator),
            "covariance": robot.covariance.tolist(),
            "compliance_sd": robot.compliance_sd.tolist(),
        }
    )


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


class FollowingArm(SimulatedArm):
    """An arm that begins trajectories some time after they were sent; `spoil` makes it a bad one."""

    LATE_S = 0.02

    def __init__(self, q: np.ndarray, spoil: str = "") -> None:
        self.time_s, self.off, self.spoil = 0.0, np.zeros(len(q)), spoil
        self._waiting: list[tuple[float, Callable[[], None]]] = []
        self._past: list[Reading] = []
        super().__init__(SIX, q, lambda: self.time_s)

    def state(self) -> Reading:
        if self.spoil == "fault":
            raise RobotRefusedError("joint 3: protective stop")
        q = super().state().encoders + (np.nan if self.spoil == "NaN" else self.off)
        self._past.append(Reading(0.0 if self.spoil == "frozen" else self.time_s, q, 0.0, PlantFlag.RUN_HELD))
        old = [reading for reading in self._past if reading.time_s < self.time_s - 0.2]
        return old[-1] if self.spoil == "late by 200 ms" and old else self._past[-1]

    def follow(self, trajectory: JointTrajectory) -> None:
        if self.spoil == "refuses":
            raise RobotRefusedError("the trajectory ends outside its workspace")
        self._later(partial(super().follow, trajectory))

    def hold(self) -> None:
        self._later(super().hold)

    def _later(self, do: Callable[[], None]) -> None:
        if self.spoil not in ("never stops", "cut short"):
            self._waiting.append((self.time_s + self.LATE_S, do))

    def advance(self, dt_s: float) -> None:
        before = self._at(self.time_s)
        self.time_s += dt_s
        moved = self._at(self.time_s) - before
        if self.spoil == "half speed":
            self.off = self.off - 0.5 * moved
        elif self.spoil == "overshoots":  # by 2 mm at the guide
            self.off = 3.5e-3 * np.sign(moved)
        # Of each joint; the slow one is 0.3 mm/s at half a metre.
        self.off = self.off + dt_s * {"drifts": 6e-4, "never stops": 0.05}.get(self.spoil, 0.0)
        while self._waiting and self._waiting[0][0] <= self.time_s:
            self._waiting.pop(0)[1]()


class Streamed(StreamedArm):
    """With the time of its arm."""

    def __init__(self, arm: FollowingArm) -> None:
        super().__init__(arm, lambda: arm.time_s)
        self.arm = arm

    def advance(self, dt_s: float) -> None:
        self.arm.advance(dt_s)
