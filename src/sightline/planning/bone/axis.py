"""The axis of neck or shaft: a line drawn in an image spans a plane in space; the planes of two images meet in it."""

from dataclasses import dataclass

import numpy as np

from sightline.common.geometry.covariance import line_direction, response
from sightline.errors import ReconstructionRefusedError
from sightline.planning.points.lines_of_sight import Sights
from sightline.planning.points.trajectory import MIN_LENGTH_MM

# At a smaller angle between the planes the axis's error is more than six times theirs [ours].
MIN_ANGLE_RAD = np.deg2rad(10.0)


@dataclass(frozen=True, eq=False)
class Axis:
    """A straight axis, CFCS.

    `ends_mm` (2, 3): its points at the first view's two clicks; `covariance_mm2` (6, 6) of both, None where a view's
    error is unknown.
    """

    ends_mm: np.ndarray
    covariance_mm2: np.ndarray | None

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector from the first end to the second."""
        along = self.ends_mm[1] - self.ends_mm[0]
        return along / np.linalg.norm(along)

    @property
    def direction_covariance_rad2(self) -> np.ndarray | None:
        """(2, 2) covariance of the direction along two axes perpendicular to it."""
        if self.covariance_mm2 is None:
            return None
        to_direction = line_direction(*self.ends_mm)
        return to_direction @ self.covariance_mm2 @ to_direction.T

    @property
    def offset_covariance_mm2(self) -> np.ndarray | None:
        """(2, 2) covariance of the middle of both ends along two axes perpendicular to it."""
        if self.covariance_mm2 is None:
            return None
        across = np.linalg.svd(self.direction[None])[2][1:]
        to_offset = np.hstack([across, across]) / 2
        return to_offset @ self.covariance_mm2 @ to_offset.T

    def distance_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the distances (...) of points (..., 3) from the axis."""
        return np.linalg.norm(np.cross(xyz_mm - self.ends_mm[0], self.direction), axis=-1)


def find_axis(sights: Sights, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends (6,) of the axis drawn as `name`, and their derivatives (6, n) by its numbers in z.

    Raises ReconstructionRefusedError where the planes do not determine it.
    """
    at = sights.values[sights.index(name)]
    rays = sights.rays(name, at[None])
    if min(np.linalg.norm(points[0, 1] - points[0, 0]) for _, points in rays) < MIN_LENGTH_MM:
        raise ReconstructionRefusedError(
            f"the two clicks of the {name} axis are too close together; draw the line longer in both images"
        )
    first, second = (np.cross(points[0, 0] - focal[0, 0], points[0, 1] - focal[0, 0]) for focal, points in rays)
    sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    if sine < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            f"the planes of the {name} axis in the two images meet at {np.rad2deg(np.arcsin(sine)):.0f}° (at least "
            f"{np.rad2deg(MIN_ANGLE_RAD):.0f}° is needed): the axis lies in the plane of both beams, where these two "
            "images do not determine it; rotate the C-arm for one of them"
        )
    ends, own = response(lambda z: _ends(sights.rays(name, z)), at)
    length = np.linalg.norm(ends[3:] - ends[:3])
    if length < MIN_LENGTH_MM:
        raise ReconstructionRefusedError(
            f"the {name} axis is drawn {length:.1f} mm long (at least {MIN_LENGTH_MM:.0f} mm is needed); draw it longer"
        )
    return ends, own


def _ends(both: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return (K, 6): where the first view's two rays intersect the plane of the second view's rays."""
    (focal_a, a), (focal_b, b) = both
    normal = np.cross(b[:, 0] - focal_b[:, 0], b[:, 1] - focal_b[:, 0])[:, None]
    rays = a - focal_a
    reach = (normal * (focal_b - focal_a)).sum(axis=-1) / (normal * rays).sum(axis=-1)
    return (focal_a + reach[..., None] * rays).reshape(len(a), 6)
