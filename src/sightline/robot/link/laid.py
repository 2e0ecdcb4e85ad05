"""Where a robot says that the wire lies, or will lie, against where it was told to lay it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.errors import RobotRefusedError

# Half of what the paper allows the tip, and a third of its direction, to err [paper, Fig. 15; ours]: what a robot says
# of itself is its encoders' word, and these resolve a hundredth of it.
TIP_LIMIT_MM = 0.5
AXIS_LIMIT_RAD = float(np.deg2rad(0.2))
# An echo is what was sent, as 32-bit numbers; a robot that turns it into a quaternion and back loses digits [ours].
_ECHO_DIGITS = 16 * np.finfo(np.float32).eps


@dataclass(frozen=True)
class Laid:
    """A wire against its target: the tip `aside_mm` of the planned axis and `along_mm` beyond the planned tip, its axis
    `angle_rad` from the planned one. Rotation about the wire does not count."""

    aside_mm: float
    along_mm: float
    angle_rad: float

    @staticmethod
    def of(wire: RigidTransform, target: RigidTransform) -> "Laid":
        """Of two poses of the wire's tip, +z along the wire, in one frame."""
        between = target.inv() * wire
        x, y, z = between.rotation.apply([0.0, 0.0, 1.0])
        tip = between.translation
        return Laid(float(np.hypot(tip[0], tip[1])), float(tip[2]), float(np.arctan2(np.hypot(x, y), z)))

    def refuse_elsewhere(self, what: str, depth_off_mm: float | None = None, zero_limit_mm: float = 0.0) -> None:
        """Raise RobotRefusedError where tip or axis are beyond their limits.

        `depth_off_mm`: by how much the robot's own depth passes the planned one, where it counts depth from a zero that
        contact or a shot has moved, by no more than `zero_limit_mm`."""
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
            f"{np.rad2deg(AXIS_LIMIT_RAD):.1f}°); stop, and find out why before anything moves"
        )


def refuse_other_pose(echo: np.ndarray, sent: np.ndarray, what: str) -> None:
    """Raise RobotRefusedError where an acknowledged matrix (4, 4) is not the one that was sent."""
    sent = np.asarray(sent, dtype=np.float32).astype(np.float64)
    size = np.maximum(np.abs(sent), 1.0)
    same = (np.abs(echo - sent) <= _ECHO_DIGITS * size) | (np.isnan(echo) & np.isnan(sent)) | (echo == sent)
    if not same.all():
        off = np.abs(echo - sent)[:3, 3]
        raise RobotRefusedError(
            f"the robot acknowledged another {what} than was sent: its origin differs by {np.max(off):.2f} mm, or its "
            "axes do; nothing may move by it"
        )
