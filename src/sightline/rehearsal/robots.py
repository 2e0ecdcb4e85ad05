"""Robots for a rehearsal: one as its calibration has it, and true ones drawn from what that leaves open."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.robot.kinematics.calibrated import MACHINED_SD, CalibratedAxes, CalibratedRobot
from sightline.robot.kinematics.manipulator import ARM_JOINTS, FEED, YAW, Manipulator, imaging_yaw, nominal_manipulator
from sightline.robot.kinematics.mounts import Mount

# Frame and wire on the flange, 1 s.d. of a twist: 0.1 mm as the accuracy trial fixes it, over a lever of 330 mm.
MOUNT_SD = np.array([3e-4] * 3 + [0.1] * 3)
# Of how the axes were machined, what their calibration leaves: 30 poses of three targets, 0.03 mm each, leave less;
# this adds 0.01 mm at the wire [calc].
AXES_LEFT = 0.1
# How far the robot's base is from where it would be ideal, joints' units: a person brings it to the table [ours].
BASE_SPREAD = np.array([10.0, 10.0, np.deg2rad(2.0), np.deg2rad(2.0), 0.0])


def calibrated_robot(side: str = "right") -> CalibratedRobot:
    """The nominal manipulator, its axes and mounts calibrated as well as a workshop does."""
    manipulator = nominal_manipulator(side)
    axes = CalibratedAxes(manipulator, np.diag(np.tile(AXES_LEFT * MACHINED_SD, ARM_JOINTS) ** 2), np.zeros((0, 0)))
    known = (manipulator.T_flange_cfcs, manipulator.T_flange_tool)
    frame, wire = (Mount(pose, np.diag(MOUNT_SD**2), np.zeros(0)) for pose in known)
    return CalibratedRobot.of(axes, frame, wire)


def true_manipulator(robot: CalibratedRobot, rng: np.random.Generator) -> Manipulator:
    """One of those that the calibration allows. The wire is fed along itself."""
    values, vectors = np.linalg.eigh(robot.covariance)
    twists = vectors @ (np.sqrt(np.clip(values, 0.0, None)) * rng.standard_normal(len(values)))
    axes, frame, wire = np.split(twists, [6 * ARM_JOINTS, 6 * ARM_JOINTS + 6])
    true = robot.manipulator.displaced(np.pad(axes.reshape(ARM_JOINTS, 6), ((0, 2), (0, 0))))
    tool = RigidTransform.from_exp_coords(wire) * robot.manipulator.T_flange_tool
    screws = true.axes.copy()
    screws[FEED, 3:] = (true.T_mcs_flange_home * tool).rotation.apply([0.0, 0.0, 1.0])
    held = RigidTransform.from_exp_coords(frame) * robot.manipulator.T_flange_cfcs
    return replace(true, axes=screws, T_flange_cfcs=held, T_flange_tool=tool)


def drawn_robot(known: CalibratedRobot, side: str, rng: np.random.Generator) -> tuple[Manipulator, np.ndarray]:
    """A true robot, and the joints (5,) that it is brought to for the images: the frame level and upright around the
    hip, as its mount is made for."""
    start = BASE_SPREAD * rng.uniform(-1, 1, 5)
    start[YAW] += imaging_yaw(side)
    return true_manipulator(known, rng), start
