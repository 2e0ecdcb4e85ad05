"""Robots for a rehearsal: the calibrated model, and true robots drawn from the uncertainty of the calibration."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from sightline.frame import Frame
from sightline.robot.kinematics.calibrated import MACHINED_SD, CalibratedAxes, CalibratedRobot
from sightline.robot.kinematics.manipulator import ARM_JOINTS, FEED, YAW, Manipulator, nominal_manipulator
from sightline.robot.kinematics.mounts import Mount
from sightline.twin.xray.setup import hip_of

# Mounts of frame or block and of wire on the flange, s.d. of a twist: 0.1 mm as in the accuracy trial, over a lever of
# 330 mm.
MOUNT_SD = np.array([3e-4] * 3 + [0.1] * 3)
# Share of the axes' machining errors that remains after calibration. 30 poses of three targets, 0.03 mm each, leave
# less; this adds 0.01 mm at the wire [calc].
REMAINING_SHARE = 0.1
# Deviation of the robot's base from its ideal place, in joint units: a person brings it to the table [ours].
BASE_SPREAD = np.array([10.0, 10.0, np.deg2rad(2.0), np.deg2rad(2.0), 0.0])
# Feed at the images of a block, mm: the tip is some 75 mm before the hip, 25 mm before the bone, and more than 20 mm of
# the wire are in both fields [ours].
SHOWN_FEED_MM = 75.0


def calibrated_robot(side: str = "right", frame: Frame | None = None, yaw_rad: float | None = None) -> CalibratedRobot:
    """Return the nominal manipulator that holds a frame (default: one with plates), with axes and mounts calibrated to
    the accuracy of a workshop. `yaw_rad`: at the images, by default that of a wire in a hip."""
    manipulator = nominal_manipulator(side, np.zeros(3) if frame is None else hip_of(frame, side), yaw_rad)
    sd = np.tile(REMAINING_SHARE * MACHINED_SD, ARM_JOINTS)
    axes = CalibratedAxes(manipulator, np.diag(sd**2), np.zeros((0, 0)))
    known = (manipulator.T_flange_cfcs, manipulator.T_flange_tool)
    held, wire = (Mount(pose, np.diag(MOUNT_SD**2), np.zeros(0)) for pose in known)
    return CalibratedRobot.of(axes, held, wire)


def shown_wire_mm(robot: Manipulator, imaged: np.ndarray, behind_mm: ArrayLike) -> np.ndarray:
    """Return the points (N, 3), CFCS, of the wire at the joints `imaged` (5,), `behind_mm` (N,) behind its tip."""
    along = -np.asarray(behind_mm)[:, None] * np.array([0.0, 0.0, 1.0])
    return (robot.T_mcs_cfcs(imaged).inv() * robot.T_mcs_tool(imaged)).apply(along)


def true_manipulator(robot: CalibratedRobot, rng: np.random.Generator) -> Manipulator:
    """Draw a true manipulator from the uncertainty of the calibration. The wire is fed along its own axis."""
    values, vectors = np.linalg.eigh(robot.covariance)
    twists = vectors @ (np.sqrt(np.clip(values, 0.0, None)) * rng.standard_normal(len(values)))
    axes, frame, wire = np.split(twists, [6 * ARM_JOINTS, 6 * ARM_JOINTS + 6])
    true = robot.manipulator.displaced(np.pad(axes.reshape(ARM_JOINTS, 6), ((0, 2), (0, 0))))
    tool = RigidTransform.from_exp_coords(wire) * robot.manipulator.T_flange_tool
    screws = true.axes.copy()
    screws[FEED, 3:] = (true.T_mcs_flange_home * tool).rotation.apply([0.0, 0.0, 1.0])
    held = RigidTransform.from_exp_coords(frame) * robot.manipulator.T_flange_cfcs
    return replace(true, axes=screws, T_flange_cfcs=held, T_flange_tool=tool)


def drawn_robot(
    known: CalibratedRobot, yaw_rad: float, rng: np.random.Generator, feed_mm: float = 0.0
) -> tuple[Manipulator, np.ndarray]:
    """Draw a true robot, and its joints (5,) at the images: about at `yaw_rad`, with the frame level and upright."""
    start = BASE_SPREAD * rng.uniform(-1, 1, 5)
    start[YAW] += yaw_rad
    start[FEED] += feed_mm
    return true_manipulator(known, rng), start
