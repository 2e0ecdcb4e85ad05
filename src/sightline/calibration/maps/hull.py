"""Where a map holds: the convex hull of the beads in the image; and refusals of beads that determine no map."""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.common.geometry.outlines import convex_hull, enclosed_area
from sightline.errors import CalibrationRefusedError, OutsideRegionError

# How far outside its controls a map may be evaluated, in radii of their convex hull, or sizes of their bounding box
# [ours]: further out no bead supports it, and a polynomial is meaningless.
MAX_OUTSIDE = 0.5
# Points whose spread across a line is below this share of that along it are collinear [ours]: across it, a map's error
# would be fifty times that along it.
MAX_COLLINEAR_RATIO = 0.02


def refuse_collinear(points: np.ndarray, what: str) -> None:
    """Raise CalibrationRefusedError for collinear points (N, 2) or (N, 3); `what`: their name in the message."""
    centred = points - points.sum(axis=0) / len(points)
    along, across = np.linalg.eigvalsh(centred.T @ centred)[[-1, -2]].tolist()
    if across <= MAX_COLLINEAR_RATIO**2 * along:
        raise CalibrationRefusedError(f"{what} lie on one line; add some that do not")


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull in the image: `corners_px` (C, 2) in order; `equations` (C, 3): outward unit normal and offset of
    each side."""

    corners_px: np.ndarray
    equations: np.ndarray

    @staticmethod
    def of(uv_px: np.ndarray) -> "Hull":
        """Return the convex hull of pixels (N, 2) that are not collinear."""
        corners = uv_px[convex_hull(uv_px)]
        along = np.concatenate([corners[1:], corners[:1]]) - corners
        equations, length = np.empty((len(corners), 3)), np.hypot(along[:, 0], along[:, 1])
        equations[:, 0], equations[:, 1] = along[:, 1] / length, -along[:, 0] / length
        equations[:, 2] = -(equations[:, :2] * corners).sum(axis=1)
        return Hull(corners, equations)

    @cached_property
    def radius_px(self) -> float:
        """Radius of the circle of equal area."""
        return float(np.sqrt(enclosed_area(self.corners_px) / np.pi))

    def distance_px(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,): the largest signed distance of pixels from the sides' lines; negative inside."""
        return (uv_px @ self.equations[:, :2].T + self.equations[:, 2]).max(axis=1)

    def contains(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether pixels (N, 2) lie inside."""
        return self.distance_px(uv_px) <= 0.0

    def is_near(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether pixels (N, 2) lie inside or near enough for the map to be evaluated."""
        return self.distance_px(uv_px) <= MAX_OUTSIDE * self.radius_px

    def refuse_far(self, uv_px: np.ndarray, view: str) -> None:
        """Raise OutsideRegionError for pixels (N, 2) of a view too far outside."""
        far = ~self.is_near(uv_px)
        if far.any():
            where = ", ".join(f"({u:.0f}, {v:.0f})" for u, v in uv_px[far][:3])
            (u_0, v_0), (u_1, v_1) = self.corners_px.min(axis=0), self.corners_px.max(axis=0)
            raise OutsideRegionError(
                f"{view}: {far.sum()} of {len(far)} pixels lie far outside the beads' convex hull: {where}; it spans u "
                f"{u_0:.0f} to {u_1:.0f}, v {v_0:.0f} to {v_1:.0f}, and nothing is calibrated beyond; choose points "
                "nearer to the beads, or move the frame so that its beads surround them"
            )


@contextmanager
def well_conditioned() -> Generator[None]:
    """Raise CalibrationRefusedError where a factorisation within finds a matrix that is not positive definite."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise CalibrationRefusedError(
            "the beads' covariances make the calibration ill-conditioned; check the stated noise, and that no bead is "
            "given twice"
        ) from None
