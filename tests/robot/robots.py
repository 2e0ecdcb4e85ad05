"""A calibrated robot for tests, and true ones drawn from what its calibration leaves open."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.robot.calibrated import COMPLIANCE_SD, MACHINED_SD, CalibratedAxes, CalibratedRobot
from sightline.robot.manipulator import FEED, Manipulator, nominal_manipulator
from sightline.robot.mounts import Mount

MOUNT_SD = np.array([3e-4] * 3 + [0.1] * 3)  # hand-eye 0.1 mm
READY = np.array([5.0, -8.0, 0.7, 0.1, 20.0])


def calibrated(axes_share: float = 0.3) -> CalibratedRobot:
    """Axes known to a share of how they were machined, mounts to MOUNT_SD."""
    manipulator = nominal_manipulator("right")
    axes = CalibratedAxes(manipulator, np.diag(np.tile(axes_share * MACHINED_SD, 4) ** 2), np.zeros((0, 0)))
    mounts = [
        Mount(pose, np.diag(MOUNT_SD**2), np.zeros(0))
        for pose in (manipulator.T_flange_cfcs, manipulator.T_flange_tool)
    ]
    return CalibratedRobot.of(axes, *mounts, compliance_sd=COMPLIANCE_SD)


def drawn(robot: CalibratedRobot, rng: np.random.Generator) -> Manipulator:
    """A true manipulator that the calibration allows."""
    twists = np.linalg.cholesky(robot.covariance + 1e-18 * np.eye(36)) @ rng.standard_normal(36)
    true = robot.manipulator.displaced(np.pad(twists[:24].reshape(4, 6), ((0, 2), (0, 0))))
    frame, wire = (RigidTransform.from_exp_coords(part) for part in (twists[24:30], twists[30:]))
    tool = wire * robot.manipulator.T_flange_tool
    screws = true.axes.copy()
    screws[FEED, 3:] = (true.T_mcs_flange_home * tool).rotation.apply([0.0, 0.0, 1.0])
    return replace(true, axes=screws, T_flange_cfcs=frame * robot.manipulator.T_flange_cfcs, T_flange_tool=tool)
