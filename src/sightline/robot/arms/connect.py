"""The adapter of an arm by the name of its controller."""

from contextlib import closing
from typing import Literal

import numpy as np

from sightline.errors import RobotRefusedError, SetUpError
from sightline.robot.arms.adapter import ArmAdapter, SimulatedArm
from sightline.robot.kinematics.manipulator import Manipulator

Controlled = Literal["sim", "franka", "ros2"]


def connect(kind: Controlled, address: str, robot: Manipulator, start: np.ndarray) -> "closing[ArmAdapter]":
    """Return the arm `robot` behind a controller at `address`, to be closed; "sim" begins at the joints `start` (n,).

    Raises RobotRefusedError for an arm that does not answer, or is another; SetUpError without the extra of its kind.
    """
    if robot.has_feed:
        raise RobotRefusedError("an arm behind its own controller has no drill: it holds a guide, without a feed")
    arm = _arm(kind, address, robot, start)
    if len(arm.joints) != robot.count:
        arm.close()
        raise RobotRefusedError(f"the arm at {address} has {len(arm.joints)} joints, the robot's file {robot.count}")
    return closing(arm)


def _arm(kind: Controlled, address: str, robot: Manipulator, start: np.ndarray) -> ArmAdapter:
    try:
        if kind == "franka":
            from sightline.robot.arms.franka import FrankaArm

            return FrankaArm(address)
        if kind == "ros2":
            from sightline.robot.arms.ros2 import Ros2Arm

            return Ros2Arm(address, robot.joints, robot.lower, robot.upper, robot.rotary)
    except ImportError as error:
        raise SetUpError(f"this arm needs more to be installed: pip install 'sightline[{kind}]'") from error
    return SimulatedArm(robot, start)
