"""Deviation of the wire, by the robot's own report, from its target."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError

# Half of the paper's limit for the tip, and a third of that for the direction [paper, Fig. 15; ours]. A robot's report
# comes from its encoders, which resolve a hundredth of these.
TIP_LIMIT_MM = 0.5
AXIS_LIMIT_RAD = float(np.deg2rad(0.2))
# Tolerance of an echo, which is in 32-bit numbers; a robot that converts it to a quaternion and back loses digits
# [ours].
_ECHO_DIGITS = 16 * np.finfo(np.float32).eps


@dataclass(frozen=True)
class WireDeviation:
    """Deviation of a wire from its target: the tip `aside_mm` from the planned axis and `along_mm` beyond the planned
    tip, its axis `angle_rad` from the planned one. Rotation about the wire does not count."""

    aside_mm: float
    along_mm: float
    angle_rad: float

    @staticmethod
    def of(wire: RigidTransform, target: RigidTransform) -> "WireDeviation":
        """Return the deviation between two poses of the wire's tip, +z along the wire, in one frame."""
        between = target.inv() * wire
        x, y, z = between.rotation.apply([0.0, 0.0, 1.0])
        tip = between.translation
        return WireDeviation(float(np.hypot(tip[0], tip[1])), float(tip[2]), float(np.arctan2(np.hypot(x, y), z)))

    def refuse_large(self, what: str, depth_off_mm: float | None = None, zero_limit_mm: float = 0.0) -> None:
        """Raise RobotRefusedError if tip or axis exceed their limits.

        `depth_off_mm`: the robot's own depth less the planned depth, for a robot whose zero of depth was corrected by
        contact or a shot, by at most `zero_limit_mm`."""
        deep = self.along_mm if depth_off_mm is None else depth_off_mm
        moved = abs(self.along_mm - deep)
        if (
            np.hypot(self.aside_mm, deep) <= TIP_LIMIT_MM
            and moved <= zero_limit_mm
            and self.angle_rad <= AXIS_LIMIT_RAD
        ):
            return
        raise RobotRefusedError(
            f"{what} elsewhere than planned: the tip {self.aside_mm:.2f} mm aside and {self.along_mm:+.2f} mm along "
            f"the wire (at most {TIP_LIMIT_MM:g} mm), its axis {np.rad2deg(self.angle_rad):.2f}° off (at most "
            f"{np.rad2deg(AXIS_LIMIT_RAD):.1f}°); stop, and find the cause before anything moves"
        )


def refuse_other_pose(echo: np.ndarray, sent: np.ndarray, what: str) -> None:
    """Raise RobotRefusedError if an acknowledged matrix (4, 4) differs from the one that was sent."""
    sent = np.asarray(sent, dtype=np.float32).astype(np.float64)
    size = np.maximum(np.abs(sent), 1.0)
    same = (np.abs(echo - sent) <= _ECHO_DIGITS * size) | (np.isnan(echo) & np.isnan(sent)) | (echo == sent)
    if not same.all():
        off = np.abs(echo - sent)[:3, 3]
        raise RobotRefusedError(
            f"the robot acknowledged another {what} than was sent: its origin differs by {np.max(off):.2f} mm, or its "
            "axes do; nothing may move by it"
        )
