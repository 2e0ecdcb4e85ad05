"""A calibrated view as an exact pinhole: its image resampled to the XRII plate as seen from the X-ray source."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sightline.calibration import BeadView, MatrixView
from sightline.calibration.exchange.pinhole import Pinhole
from sightline.calibration.maps.undistort import PlaneImage, undistort
from sightline.calibration.matrix_view import HomographyMap
from sightline.calibration.view import LinesOfSight
from sightline.errors import RefusedError

# A raw image passes as a pinhole image up to the error of a careful click [physics.md, Picks].
MAX_RESIDUAL_PX = 0.5
_GRID = 7  # [ours] samples per side; a projection matrix has 11 parameters


@dataclass(frozen=True, eq=False)
class PlateImage:
    """The plate as seen from the X-ray source.

    `pinhole` is exact: no distortion is left. `pixels` (H, W); None if the view had no image. `inside_hull` (H, W)
    bool: whether the line of sight lies inside the convex hull of the beads.
    """

    pinhole: Pinhole
    pixels: np.ndarray | None
    inside_hull: np.ndarray


def plate_image(view: BeadView, pixels: np.ndarray | None, spacing_mm: float | None = None) -> PlateImage:
    """Resample an image (H, W) of a view; without `pixels` return the geometry only. Raises what `undistort` raises."""
    image = undistort(np.zeros((16, 16), np.uint8) if pixels is None else pixels, view.plane_map, view.hull, spacing_mm)
    flipped = bool(np.sign(view.plane.height_mm(view.focal_point_mm)) > 0)  # the source sees the plane from behind
    side = slice(None, None, -1) if flipped else slice(None)
    pinhole = _pinhole(view, image, flipped)
    return PlateImage(
        pinhole=pinhole,
        pixels=None if pixels is None else np.ascontiguousarray(image.pixels[:, side]),
        inside_hull=np.ascontiguousarray(image.inside_hull[:, side]),
    )


def _pinhole(view: BeadView, image: PlaneImage, flipped: bool) -> Pinhole:
    height, width = image.pixels.shape
    spacing = image.spacing_mm
    focal = view.focal_point_mm
    across = -view.plane.axes[0] if flipped else view.plane.axes[0]
    down = view.plane.axes[1]
    rotation = np.stack([across, down, np.cross(across, down)])
    foot = (view.plane.to_plane(focal) - image.origin_mm) / spacing
    distance = abs(float(view.plane.height_mm(focal))) / spacing
    centre = width - 1 - foot[0] if flipped else foot[0]
    camera = np.array([[distance, 0.0, centre], [0.0, distance, foot[1]], [0.0, 0.0, 1.0]])
    pinhole = Pinhole(view.name, camera, rotation, -rotation @ focal, (height, width), (spacing, spacing))
    rows, columns = _inside(image.inside_hull)
    sight = view.lines_of_sight(image.uv_px[rows, columns])
    seen_at = np.column_stack([width - 1 - columns if flipped else columns, rows]).astype(np.float64)
    return _with_errors(pinhole, seen_at, sight)


def _inside(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of a grid of pixels within a mask."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, _GRID).astype(int) for n in mask.shape), indexing="ij"))
    rows, columns = grid.reshape(2, -1)
    kept = mask[rows, columns]
    return rows[kept], columns[kept]


def _with_errors(pinhole: Pinhole, uv_px: np.ndarray, sight: LinesOfSight) -> Pinhole:
    """Return the pinhole with the matrix covariance that best gives its lines of sight the errors of the view.

    Focal point and homography are the 11 parameters of a matrix, so their errors carry over. Errors of the plane map
    that no matrix can describe are left out.
    """
    if sight.covariance is None:
        return pinhole
    response = _response(pinhole.matrix, uv_px, sight)
    to_entries = np.linalg.pinv(response, rcond=1e-12)
    whole = np.sum(list(sight.covariance.values()), axis=0)
    covariance = to_entries @ whole @ to_entries.T
    deviation = np.sqrt(np.trace(whole[3:, 3:]) / len(uv_px))
    note = f"lines of sight have an error of {deviation:.3f} mm rms on the plate, without the error of picks"
    return replace(pinhole, covariance=0.5 * (covariance + covariance.T), note=note)


def _response(matrix: np.ndarray, uv_px: np.ndarray, sight: LinesOfSight) -> np.ndarray:
    """Return the Jacobian (3 + 2N, 12) of the focal point and the plane coordinates of fixed pixels with respect to the
    entries of the matrix, row by row.

    From P (F, 1) = 0, and (row 0 - u row 2) (X, 1) = 0 = (row 1 - v row 2) (X, 1) for X in the plane.
    """
    jacobian = np.empty((3 + 2 * len(uv_px), 12))
    jacobian[:3] = -np.linalg.solve(matrix[:, :3], np.kron(np.eye(3), np.append(sight.focal_point_mm, 1.0)))
    for i, (uv, point) in enumerate(zip(uv_px, sight.points_mm, strict=True)):
        pick = np.column_stack([np.eye(2), -uv])
        along = (pick @ matrix)[:, :3] @ sight.plane.axes.T
        jacobian[3 + 2 * i : 5 + 2 * i] = -np.linalg.solve(along, np.kron(pick, np.append(point, 1.0)))
    return jacobian


def pinhole_of(view: BeadView | MatrixView) -> Pinhole:
    """Return the pinhole of a calibrated view of an image without distortion, or of the nearest one, with its errors
    as far as it is exact.

    Raises RefusedError above MAX_RESIDUAL_PX.
    """
    if isinstance(view, MatrixView):
        return Pinhole.of_matrix(view.matrix, view.name, covariance=view.covariance)
    pinhole, _ = raw_pinhole(view, view.image_shape)
    if not isinstance(view.plane_map, HomographyMap):
        return pinhole
    low, high = view.hull.corners_px.min(axis=0), view.hull.corners_px.max(axis=0)
    uv = np.stack(np.meshgrid(*np.linspace(low, high, _GRID).T), axis=-1).reshape(-1, 2)
    uv = uv[view.hull.contains(uv)]
    return _with_errors(replace(pinhole, note=""), uv, view.lines_of_sight(uv))


def raw_pinhole(view: BeadView, shape: tuple[int, int] | None) -> tuple[Pinhole, float]:
    """Return the pinhole that fits the raw image (H, W) best, with the view's focal point, and its largest residual
    inside the convex hull of the beads, px. It has no covariance: the remaining distortion is not noise.

    Raises RefusedError above MAX_RESIDUAL_PX.
    """
    low, high = view.hull.corners_px.min(axis=0), view.hull.corners_px.max(axis=0)
    u, v = np.meshgrid(*(np.linspace(low[k], high[k], 3 * _GRID) for k in (0, 1)))
    uv = np.column_stack([u.ravel(), v.ravel()])
    uv = uv[view.hull.contains(uv)]
    xy = view.plane_map.to_plane(uv)
    homography, _ = cv2.findHomography(xy, uv, 0)
    seen = np.column_stack([xy, np.ones(len(xy))]) @ homography.T
    residual = float(np.linalg.norm(seen[:, :2] / seen[:, 2:] - uv, axis=1).max())
    if residual > MAX_RESIDUAL_PX:
        raise RefusedError(
            f"the {view.name} image is too distorted for a pinhole: the best fit has an error of up to {residual:.1f} "
            f"px (limit {MAX_RESIDUAL_PX:g} px); export the undistorted image, without --raw"
        )
    onto = _projection_onto(view)
    note = f"of the raw image: distortion of up to {residual:.2f} px is left"
    return replace(Pinhole.of_matrix(homography @ onto, view.name, shape), note=note), residual


def _projection_onto(view: BeadView) -> np.ndarray:
    """Return the central projection (3, 4) from CFCS to homogeneous coordinates of the view's plane."""
    height, foot = float(view.plane.height_mm(view.focal_point_mm)), view.plane.to_plane(view.focal_point_mm)
    to_height = np.append(view.plane.normal, -view.plane.normal @ view.plane.origin_mm)
    to_plane = np.column_stack([view.plane.axes, -view.plane.axes @ view.plane.origin_mm])
    return np.vstack([height * to_plane - np.outer(foot, to_height), height * np.eye(4)[3] - to_height])
