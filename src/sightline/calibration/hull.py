"""The convex hull of the beads in the image."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from sightline.errors import CalibrationRefusedError, OutsideRegionError

# How far outside the hull a map may still be asked, in radii of the hull [ours]: farther out no bead says anything.
REACH = 0.5
# Points nearer to one line than this share of their length are collinear [ours].
MAX_COLLINEAR_RATIO = 0.02


def refuse_collinear(points: np.ndarray, what: str) -> None:
    """Raises CalibrationRefusedError where points (N, 2) or (N, 3) lie on one line; `what` they are, in words."""
    apart = points - points.mean(axis=0)
    along, across = np.linalg.eigvalsh(apart.T @ apart)[[-1, -2]]
    if across <= MAX_COLLINEAR_RATIO**2 * along:
        raise CalibrationRefusedError(f"{what} lie on one line; more of them, beside that line, are needed")


@dataclass(frozen=True, eq=False)
class Hull:
    """`corners_px` (C, 2) in order; `equations` (C, 3): unit outward normal and offset of each side."""

    corners_px: np.ndarray
    equations: np.ndarray

    @staticmethod
    def of(uv_px: np.ndarray) -> "Hull":
        """Of pixels (N, 2) that do not lie on one line."""
        hull = ConvexHull(uv_px)
        return Hull(uv_px[hull.vertices], hull.equations)

    @cached_property
    def radius_px(self) -> float:
        """Of the circle of equal area."""
        x, y = self.corners_px.T
        return float(np.sqrt(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / np.pi))

    def distance_px(self, uv_px: np.ndarray) -> np.ndarray:
        """(N,) how far pixels lie outside the farthest side's line; negative inside."""
        return (uv_px @ self.equations[:, :2].T + self.equations[:, 2]).max(axis=1)

    def contains(self, uv_px: np.ndarray) -> np.ndarray:
        """(N,) bool."""
        return self.distance_px(uv_px) <= 0.0

    def is_near(self, uv_px: np.ndarray) -> np.ndarray:
        """(N,) bool: not too far outside for the map to be asked."""
        return self.distance_px(uv_px) <= REACH * self.radius_px

    def refuse_far(self, uv_px: np.ndarray) -> None:
        """Raises OutsideRegionError for pixels too far outside."""
        far = ~self.is_near(uv_px)
        if far.any():
            where = ", ".join(f"({u:.0f}, {v:.0f})" for u, v in uv_px[far][:3])
            raise OutsideRegionError(
                f"{far.sum()} pixels lie far outside the beads' hull ({where}), where nothing is calibrated; "
                "choose points nearer to the beads, or move the frame so that its beads surround them"
            )
