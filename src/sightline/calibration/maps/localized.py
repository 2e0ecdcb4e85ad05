"""Plane map of Browbank et al. (2000), section 4.4, eqs 3-6: linear in the triangle of beads that contains the point.

The paper uses the three beads closest to the point. On a square grid these can be collinear; [P] of eq. 4 is then
singular. Here the containing triangle of the Delaunay triangulation of the image points is used instead.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sightline.calibration.view import PlaneMap
from sightline.errors import CalibrationRefusedError, OutsideRegionError

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

# A triangle whose height is below this share of its longest side is a sliver [ours]: it magnifies the errors of its
# corners tenfold. Half a square has 0.5.
MIN_FLATNESS = 0.1
_EDGE = 1e-9  # barycentric: a point on an edge belongs to the triangle


@dataclass(frozen=True, eq=False)
class LocalizedMap(PlaneMap):
    """Piecewise linear map through controls `controls_px` (N, 2), `controls_mm` (N, 2).

    `usable` (T,) bool: the triangles that are not slivers; only these are used.
    """

    controls_px: np.ndarray
    controls_mm: np.ndarray
    triangulation: "Delaunay"
    usable: np.ndarray

    @staticmethod
    def fit(uv_px: np.ndarray, xy_mm: np.ndarray) -> "LocalizedMap":
        """Return the map through controls (N, 2). Raises CalibrationRefusedError if no triangle is usable."""
        from scipy.spatial import Delaunay, QhullError  # here: other methods do not need it, and it takes 6 MB

        try:
            triangulation = Delaunay(uv_px)
        except (QhullError, ValueError):
            raise CalibrationRefusedError(
                f"{len(uv_px)} beads do not span a triangle; use at least three that do not lie on one line"
            ) from None
        usable = (_flatness(uv_px[triangulation.simplices]) > MIN_FLATNESS) & (
            _flatness(xy_mm[triangulation.simplices]) > MIN_FLATNESS
        )
        if not usable.any():
            raise CalibrationRefusedError(
                f"all beads lie nearly on one line (triangle height below {100 * MIN_FLATNESS:.0f} % of its side); "
                "use beads spread over the plate"
            )
        return LocalizedMap(uv_px, xy_mm, triangulation, usable)

    @property
    def triangles_px(self) -> np.ndarray:
        """(T, 3, 2) corners of the triangles that are used, in the image."""
        return self.controls_px[self.triangulation.simplices[self.usable]]

    @cached_property
    def _affine(self) -> np.ndarray:
        """(T, 2, 3): A of eq. 4 for each triangle; W = A (x, y, 1)."""
        corners = self.controls_px[self.triangulation.simplices]
        p = np.concatenate([np.swapaxes(corners, 1, 2), np.ones((len(corners), 1, 3))], axis=1)
        w = np.swapaxes(self.controls_mm[self.triangulation.simplices], 1, 2)
        p[~self.usable] = np.eye(3)
        return w @ np.linalg.inv(p)

    def containing_triangle(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N,) int: the index of the usable triangle that contains each pixel (N, 2), -1 if there is none."""
        triangle = self.triangulation.find_simplex(uv_px, tol=_EDGE)
        return np.where((triangle >= 0) & self.usable[triangle], triangle, -1)

    def _inside(self, uv_px: np.ndarray) -> np.ndarray:
        triangle = self.containing_triangle(uv_px)
        if (triangle < 0).any():
            where = ", ".join(f"({u:.1f}, {v:.1f})" for u, v in uv_px[triangle < 0][:3])
            raise OutsideRegionError(
                f"{(triangle < 0).sum()} pixels lie in no triangle of beads ({where}); the localized method does not "
                "extrapolate: choose points inside the beads' convex hull, or the smooth method"
            )
        return triangle

    def weights(self, uv_px: np.ndarray) -> np.ndarray:
        """Return (N, controls): to_plane(uv) = weights @ the controls' plane coordinates. Raises OutsideRegionError."""
        triangle = self._inside(uv_px)
        transform = self.triangulation.transform[triangle]
        first = np.einsum("nij,nj->ni", transform[:, :2], uv_px - transform[:, 2])
        weights = np.zeros((len(uv_px), len(self.controls_px)))
        shares = np.concatenate([first, 1 - first.sum(axis=1, keepdims=True)], axis=1)
        np.put_along_axis(weights, self.triangulation.simplices[triangle], shares, axis=1)
        return weights

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`, constant in a triangle. Raises OutsideRegionError."""
        a = self._affine[self._inside(uv_px)]
        return np.einsum("nij,nj->ni", a[:, :, :2], uv_px) + a[:, :, 2], a[:, :, :2]

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) that lie in a triangle, and which do, (N,) bool."""
        shares = np.einsum("tij,nj->nti", self._barycentric, np.column_stack([xy_mm, np.ones(len(xy_mm))]))
        inside = (shares >= -_EDGE).all(axis=2)
        mapped, first = inside.any(axis=1), inside.argmax(axis=1)
        rows = np.flatnonzero(mapped)
        return np.einsum("nk,nkc->nc", shares[rows, first[rows]], self.triangles_px[first[rows]]), mapped

    @cached_property
    def _barycentric(self) -> np.ndarray:
        """(T, 3, 3): takes (x, y, 1) of the plane to barycentric coordinates in each used triangle."""
        corners = self.controls_mm[self.triangulation.simplices[self.usable]]
        return np.linalg.inv(np.concatenate([np.swapaxes(corners, 1, 2), np.ones((len(corners), 1, 3))], axis=1))


def _flatness(triangles: np.ndarray) -> np.ndarray:
    """Return (T,) height over longest side of triangles (T, 3, 2)."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    twice_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    longest2 = np.max([(a**2).sum(1), (b**2).sum(1), ((a - b) ** 2).sum(1)], axis=0)
    return twice_area / np.maximum(longest2, 1e-300)
