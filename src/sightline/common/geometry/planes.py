"""Planes with two axes, such as the reference plane of a view."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sightline.common.geometry.lines import across as _across
from sightline.common.geometry.lines import unit
from sightline.errors import OutsideRegionError, UnusableInputError

# Where the choice of axes changes (see `Plane.fit`), sine of 6° and cosine of 26° [ours]: far from frames' plates,
# whose axes would otherwise change with their tilt.
_LEVEL, _ALONG_X = 0.1, 0.9
_COLLINEAR = 1e-9  # ratio of spreads across and along a line, below which rounding determines the plane


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in space: `origin_mm` (3,) on it, `axes` (2, 3) orthonormal in it; its normal is axes[0] x axes[1]."""

    origin_mm: np.ndarray
    axes: np.ndarray

    def __post_init__(self) -> None:
        for name in ("origin_mm", "axes"):
            value = np.array(getattr(self, name), dtype=np.float64)
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @staticmethod
    def fit(xyz_mm: np.ndarray) -> "Plane":
        """Return the least-squares plane of points (N, 3).

        The normal points to +Z; where it lies within 6° of the XY plane, to +X; where that is level too, to +Y.
        Axis 0 is +X projected onto the plane, or +Y where the normal is within 26° of X. So the axes do not depend on
        the order of the points, and change little with the tilt of a measured plate.
        Raises UnusableInputError for points on one line.
        """
        points = np.asarray(xyz_mm, dtype=np.float64).reshape(-1, 3)
        origin = points.mean(axis=0) if len(points) else np.zeros(3)
        _, spread, directions = np.linalg.svd(np.vstack([points - origin, np.zeros((3, 3))]))
        if not spread[1] > _COLLINEAR * spread[0]:
            raise UnusableInputError(
                "points on one line, or fewer than three, lie in no single plane; add points beside it"
            )
        return Plane.across(directions[2], origin)

    @staticmethod
    def across(normal: np.ndarray, origin_mm: np.ndarray) -> "Plane":
        """Return the plane through `origin_mm` with a normal (3,) of either sign and the axes that `fit` chooses."""
        normal = unit(np.asarray(normal, dtype=np.float64))
        leading = next((normal[axis] for axis in (2, 0) if abs(normal[axis]) > _LEVEL), normal[1])
        normal = normal * np.sign(leading)
        axis0 = unit(_across(np.eye(3)[1 if abs(normal[0]) > _ALONG_X else 0], normal))
        return Plane(np.asarray(origin_mm), np.stack([axis0, np.cross(normal, axis0)]))

    @cached_property
    def normal(self) -> np.ndarray:
        """Unit normal (3,)."""
        normal = np.cross(self.axes[0], self.axes[1])
        normal.flags.writeable = False
        return normal

    @cached_property
    def basis(self) -> np.ndarray:
        """(3, 3), its rows: both axes and the normal."""
        basis = np.vstack([self.axes, self.normal])
        basis.flags.writeable = False
        return basis

    def to_space(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return points (..., 3) in space of plane coordinates (..., 2)."""
        return self.origin_mm + np.asarray(xy_mm) @ self.axes

    def to_plane(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the orthogonal projection of points (..., 3) in plane coordinates (..., 2)."""
        return (np.asarray(xyz_mm) - self.origin_mm) @ self.axes.T

    def height_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the signed distance (...) of points (..., 3) from the plane, along its normal."""
        return (np.asarray(xyz_mm) - self.origin_mm) @ self.normal

    def central_projection(self, focal_point_mm: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
        """Return points (..., 3) projected from a focal point (3,) onto the plane, in plane coordinates (..., 2).

        Raises OutsideRegionError for a point level with the focal point or behind it: it casts no shadow on the plane.
        """
        focal = np.asarray(focal_point_mm)
        ahead = self._ahead(focal, xyz_mm)
        refuse_behind(ahead)
        return self.to_plane(focal + (np.asarray(xyz_mm) - focal) / np.asarray(ahead)[..., None])

    def shadows(self, focal_point_mm: np.ndarray, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `central_projection` (M, 2) of the points (N, 3) that cast a shadow, and (N,) bool: which do."""
        xyz, ahead = np.asarray(xyz_mm), self._ahead(focal_point_mm, xyz_mm)
        casts = ahead > 0
        return self.to_plane(focal_point_mm + (xyz[casts] - focal_point_mm) / ahead[casts, None]), casts

    def _ahead(self, focal_point_mm: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the depth (...) of points from the focal point, over that of the plane; 0 if F is in the plane."""
        h = self.height_mm(focal_point_mm)
        return 1 - self.height_mm(xyz_mm) / h if h else np.zeros(np.shape(xyz_mm)[:-1])


def refuse_behind(depth: np.ndarray) -> None:
    """Raise OutsideRegionError for points not in front of the focal point; `depth` (...): from it, over the plane's."""
    if not np.all(depth > 0):
        raise OutsideRegionError(
            "a point lies level with the focal point or behind it and casts no shadow on the plate; "
            "check its coordinates, and which plate is nearer to the source"
        )
