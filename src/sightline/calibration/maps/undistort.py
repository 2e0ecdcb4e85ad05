"""Resampling of an image to its view's reference plane, which removes distortion and that plane's perspective."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from sightline.calibration.maps.hull import Hull
from sightline.calibration.view import PlaneMap
from sightline.common.bounded import MAX_PIXELS
from sightline.errors import UnusableInputError

# The map is inverted at nodes this far apart, with a cubic spline between them; a plane map varies over 30 mm and more
# (physics.md, Distortion), so the spline is within 0.01 px of it [calc, in its test].
_NODES_MM = 2.0


@dataclass(frozen=True, eq=False)
class PlaneImage:
    """An image on the reference plane: pixel (column j, row i) lies at `origin_mm` + `spacing_mm` (j, i).

    `pixels` (h, w), 0 outside the original image; `uv_px` (h, w, 2): each pixel's place in the original image;
    `inside_hull` (h, w) bool: within the beads' convex hull, where the map does not extrapolate. A row runs along axis
    0 of the plane, a column along axis 1.
    """

    pixels: np.ndarray
    origin_mm: np.ndarray
    spacing_mm: float
    uv_px: np.ndarray
    inside_hull: np.ndarray


def undistort(pixels: np.ndarray, plane_map: PlaneMap, hull: Hull, spacing_mm: float | None = None) -> PlaneImage:
    """Return an image (H, W) resampled to the plane, over the bounding box of the beads' convex hull there.

    `spacing_mm`: of the new pixels; by default the size of an original pixel in the middle. Raises UnusableInputError
    for a spacing that gives no image or a huge one, OutsideRegionError.
    """
    if spacing_mm is None:
        middle = hull.corners_px.mean(axis=0, keepdims=True)
        spacing_mm = float(np.sqrt(abs(np.linalg.det(plane_map.jacobian(middle)[0]))))
    corners_mm = plane_map.to_plane(hull.corners_px)
    origin, extent = corners_mm.min(axis=0), np.ptp(corners_mm, axis=0)
    if not (np.isfinite(spacing_mm) and spacing_mm > 0) or np.prod(extent / spacing_mm) > MAX_PIXELS:
        raise UnusableInputError(f"a spacing of {spacing_mm} mm does not give an image of a usable size; try 0.2")
    uv_px = _sources(plane_map, origin, extent, spacing_mm)
    return PlaneImage(
        pixels=cv2.remap(pixels, uv_px[..., 0].astype(np.float32), uv_px[..., 1].astype(np.float32), cv2.INTER_CUBIC),
        origin_mm=origin,
        spacing_mm=spacing_mm,
        uv_px=uv_px,
        inside_hull=hull.contains(uv_px.reshape(-1, 2)).reshape(uv_px.shape[:2]),
    )


def _sources(plane_map: PlaneMap, origin: np.ndarray, extent: np.ndarray, spacing_mm: float) -> np.ndarray:
    """Return (h, w, 2): the original pixels of the grid on the plane."""
    x, y = (origin[k] + spacing_mm * np.arange(int(extent[k] / spacing_mm) + 1) for k in (0, 1))
    node_x, node_y = (np.linspace(a[0], a[-1], max(5, 1 + int(np.ptp(a) / _NODES_MM))) for a in (x, y))
    nodes = np.stack(np.meshgrid(node_x, node_y, indexing="ij"), axis=-1)
    uv = plane_map.to_image(nodes.reshape(-1, 2)).reshape(nodes.shape)
    return np.stack([RectBivariateSpline(node_x, node_y, uv[..., k])(x, y).T for k in (0, 1)], axis=-1)
