"""A view from another system's projection matrix."""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import Deferred, LineErrors, LinesOfSight, PlaneMap, finite_pixels
from sightline.common.checks import Check
from sightline.common.geometry.planes import Plane
from sightline.common.show import Shown, checks_lines, numbers
from sightline.errors import OutsideRegionError, UnusableInputError

# For a source at infinity the unit rows of the left 3x3 block span less volume than this [ours]: those of a C-arm span
# about 1, and rounding leaves 1e-16 of none.
MIN_VOLUME = 1e-9
# The reference plane passes through the origin, but stays at least this far from the source [ours]: a C-arm's is some
# 600 mm away, and through the source no ray meets the plane in a point.
MIN_DISTANCE_MM = 1.0


@dataclass(frozen=True, eq=False)
class HomographyMap(PlaneMap):
    """A map without distortion: `homography` (3, 3) takes (x, y, 1) of the plane to pixels."""

    homography: np.ndarray

    @staticmethod
    def of(matrix: np.ndarray, plane: Plane) -> "HomographyMap":
        """Return the map between the image of a projection matrix (3, 4) and a plane."""
        return HomographyMap(matrix @ np.vstack([np.column_stack([plane.axes.T, plane.origin_mm]), [0.0, 0.0, 1.0]]))

    def to_plane(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the plane coordinates (N, 2), mm, of pixels (N, 2). Raises OutsideRegionError on the horizon."""
        return _apply(np.linalg.inv(self.homography), uv_px)

    def to_image(self, xy_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of plane coordinates (N, 2). Raises OutsideRegionError on the horizon."""
        return _apply(self.homography, xy_mm)

    def find_image(self, xy_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the plane coordinates (N, 2) off the horizon, and which these are, (N,) bool."""
        homogeneous, regular = _homogeneous(self.homography, xy_mm)
        return homogeneous[regular, :2] / homogeneous[regular, 2:], regular

    def linearised(self, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `to_plane` and `jacobian`."""
        inverse = np.linalg.inv(self.homography)
        xy, depth = self.to_plane(uv_px), np.column_stack([uv_px, np.ones(len(uv_px))]) @ inverse[2]
        return xy, (inverse[:2, :2] - xy[:, :, None] * inverse[2, :2]) / depth[:, None, None]


def _homogeneous(matrix: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the homogeneous images (N, 3) of points (N, 2), and which lie off the matrix's horizon, (N,) bool."""
    image = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    size = np.abs(matrix[2]) @ np.array([*np.abs(points).max(axis=0, initial=0.0), 1.0])
    return image, np.abs(image[:, 2]) >= 1e-12 * size


def _apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    homogeneous, regular = _homogeneous(matrix, points)
    if not regular.all():
        raise OutsideRegionError("a point cannot be mapped: its ray is parallel to the plane; check the matrix")
    return homogeneous[:, :2] / homogeneous[:, 2:]


@dataclass(frozen=True, eq=False, repr=False)
class MatrixView(Shown):
    """A `CalibratedView` without beads.

    `matrix` (3, 4) takes CFCS, mm, to pixels; `covariance` (12, 12), or None: of its entries, row by row. A matrix
    holds for the whole image, so every pixel counts as inside the calibrated region.
    """

    name: str
    matrix: np.ndarray
    covariance: np.ndarray | None
    plane: Plane
    focal_point_mm: np.ndarray
    method: str = "matrix"
    checks: tuple[Check, ...] = ()

    def __post_init__(self) -> None:
        for array in (self.matrix, self.focal_point_mm):
            array.flags.writeable = False

    def summary(self) -> str:
        """Return the focal point, and whether the error is known."""
        known = "unknown: every verdict on it is NO-GO" if self.covariance is None else "known, from the matrix's"
        focal = f"  focal point {numbers(self.focal_point_mm, 1)} mm, CFCS"
        return "\n".join([f"View {self.name} of a matrix", focal, f"  error {known}", *checks_lines(self.checks, 3)])

    @property
    def plane_map(self) -> HomographyMap:
        """The map between image and reference plane."""
        return HomographyMap.of(self.matrix, self.plane)

    def project(self, xyz_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of points (N, 3), CFCS. Raises OutsideRegionError."""
        xyz = np.asarray(xyz_mm, dtype=np.float64)
        return self.plane_map.to_image(self.plane.central_projection(self.focal_point_mm, xyz))

    def project_seen(self, xyz_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels (M, 2) of the points (N, 3), CFCS, that `project` accepts, and which, (N,) bool."""
        xy, seen = self.plane.shadows(self.focal_point_mm, xyz_mm)
        uv, regular = self.plane_map.find_image(xy)
        seen[seen] = regular
        return uv, seen

    def lines_of_sight(self, uv_px: np.ndarray) -> LinesOfSight:
        """Return the lines of sight of pixels (N, 2); their error is unknown where the matrix has no covariance.

        Raises UnusableInputError, OutsideRegionError.
        """
        uv = finite_pixels(uv_px)
        xy, given = self.plane_map.to_plane(uv), self.covariance
        return LinesOfSight(
            view=self.name,
            plane=self.plane,
            focal_point_mm=self.focal_point_mm,
            xy_mm=xy,
            jacobian=self.plane_map.jacobian(uv),
            covariance=None if given is None else Deferred(lambda: self._by_source(uv, xy, given)),
            shared={},
            frame_key=None,
            inside_hull=np.ones(len(uv), dtype=bool),
        )

    def _by_source(self, uv_px: np.ndarray, xy_mm: np.ndarray, given: np.ndarray) -> dict[str, np.ndarray]:
        """Return the covariance for each of SOURCES from that of the matrix, `given`.

        From P (F, 1) = 0 and, for X in the plane, (row 0 - u row 2) (X, 1) = 0 = (row 1 - v row 2) (X, 1).
        """
        size = 3 + 2 * len(uv_px)
        response = np.empty((size, 12))
        focal = np.append(self.focal_point_mm, 1.0)
        response[:3] = -np.linalg.solve(self.matrix[:, :3], np.kron(np.eye(3), focal))
        for i, (uv, point) in enumerate(zip(uv_px, self.plane.to_space(xy_mm), strict=True)):
            pick = np.column_stack([np.eye(2), -uv])
            by_xy = (pick @ self.matrix)[:, :3] @ self.plane.axes.T
            response[3 + 2 * i : 5 + 2 * i] = -np.linalg.solve(by_xy, np.kron(pick, np.append(point, 1.0)))
        noise = response @ given @ response.T
        return LineErrors(noise, np.zeros_like(noise), np.zeros((size, 0))).by_source()


def view_from_matrix(P: np.ndarray, covariance: np.ndarray | None = None, name: str = "matrix") -> MatrixView:
    """Return the view of a 3x4 matrix that takes CFCS points (x, y, z, 1), mm, to pixels (u w, v w, w), as in OpenCV.

    `covariance` (12, 12): of the entries of P, row by row, at the scale of P as given; it may be singular along P,
    whose scale is arbitrary. None: the error is unknown, and every verdict based on it is NO-GO. The reference plane is
    normal to the view's axis and passes through the CFCS origin. Raises UnusableInputError.

    >>> P = np.array([[5000.0, 0, 512, 3e5], [0, 5000, 512, 3e5], [0, 0, 1, 600]])
    >>> sl.view_from_matrix(P).focal_point_mm.round(1)
    array([   1.4,    1.4, -600. ])
    """
    matrix = np.array(P, dtype=np.float64)
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
        raise UnusableInputError(f"give a finite projection matrix of the shape (3, 4); got the shape {matrix.shape}")
    lengths = np.linalg.norm(matrix[:, :3], axis=1)
    if not lengths.all() or abs(np.linalg.det(matrix[:, :3] / lengths[:, None])) < MIN_VOLUME:
        raise UnusableInputError(
            "the matrix has no focal point: its left 3x3 block is singular; give a perspective projection, mm to px"
        )
    focal = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    axis = matrix[2, :3] / lengths[2]
    if abs(axis @ focal) < MIN_DISTANCE_MM:
        raise UnusableInputError(
            "the matrix puts the X-ray source at the depth of the CFCS origin; check its coordinate system and units"
        )
    plane = Plane.fit(_spanning_points(axis))
    return MatrixView(name, matrix, _checked(covariance), plane, focal)


def _spanning_points(normal: np.ndarray) -> np.ndarray:
    """Return four points (4, 3) about the origin that span the plane with this normal."""
    across = np.linalg.svd(normal[None])[2][1:]
    return np.concatenate([across, -across])


def _checked(covariance: np.ndarray | None) -> np.ndarray | None:
    if covariance is None:
        return None
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (12, 12) or not np.isfinite(matrix).all():
        raise UnusableInputError(f"the matrix's covariance must be finite, of the shape (12, 12); got {matrix.shape}")
    if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() < -1e-9 * np.abs(matrix).max():
        raise UnusableInputError(
            "the matrix's covariance is not symmetric and positive semi-definite; give that of its 12 entries"
        )
    return matrix
