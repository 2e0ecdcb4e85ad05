"""A plane with two axes: the reference plane of a view."""

from dataclasses import dataclass

import numpy as np


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
        """The least-squares plane of points (N, 3); the axes lie as near as can be to those of space.

        Axis 0 is the in-plane direction nearest to +X, +Y or +Z, whichever lies best in the plane (ties: in that
        order), and the normal points to the positive half of the space axis nearest to it: the same plate gives
        the same axes whatever the order of its beads.
        """
        points = np.asarray(xyz_mm, dtype=np.float64)
        origin = points.mean(axis=0)
        normal = np.linalg.svd(points - origin)[2][2]
        normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
        first = np.argmin(np.round(np.abs(normal), 6))
        axis0 = np.eye(3)[first] - normal[first] * normal
        axis0 /= np.linalg.norm(axis0)
        return Plane(origin, np.stack([axis0, np.cross(normal, axis0)]))

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit normal."""
        return np.cross(self.axes[0], self.axes[1])

    def to_space(self, xy_mm: np.ndarray) -> np.ndarray:
        """Plane coordinates (..., 2) to space (..., 3)."""
        return self.origin_mm + np.asarray(xy_mm) @ self.axes

    def to_plane(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Orthogonal projection of points (..., 3), in plane coordinates (..., 2)."""
        return (np.asarray(xyz_mm) - self.origin_mm) @ self.axes.T

    def height_mm(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Signed distance of points (..., 3) from the plane, along its normal."""
        return (np.asarray(xyz_mm) - self.origin_mm) @ self.normal

    def central_projection(self, focal_point_mm: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
        """Points (..., 3) projected from a focal point (3,) onto the plane, in plane coordinates (..., 2)."""
        focal = np.asarray(focal_point_mm)
        h = self.height_mm(focal)
        scale = h / (h - self.height_mm(xyz_mm))
        return self.to_plane(focal + scale[..., None] * (np.asarray(xyz_mm) - focal))
