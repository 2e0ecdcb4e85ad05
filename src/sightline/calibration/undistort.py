"""An image resampled to the reference plane of its view: distortion and perspective of that plane are gone."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from sightline.calibration.hull import Hull
from sightline.calibration.view import PlaneMap
from sightline.errors import UnusableInputError

# The map is inverted at nodes this far apart and splined between them; a plane map bends over 30 mm and more
# (physics.md, Distortion), so a cubic spline is within 0.01 px of it [calc, in its test].
_NODES_MM = 2.0
_MAX_PIXELS = 2**25  # [ours]


@dataclass(frozen=True, eq=False)
class PlaneImage:
    """An image on the reference plane: pixel (column j, row i) lies at `origin_mm` + `spacing_mm` (j, i).

    `pixels` (h, w), 0 where the image does not reach; `uv_px` (h, w, 2): where in the image each comes from;
    `inside_hull` (h, w) bool: within the beads' hull, where the map does not extrapolate. Plane coordinates; a row
    runs along axis 0 of the plane, a column along axis 1.
    """

    pixels: np.ndarray
    origin_mm: np.ndarray
    spacing_mm: float
    uv_px: np.ndarray
    inside_hull: np.ndarray


def undistort(pixels: np.ndarray, plane_map: PlaneMap, hull: Hull, spacing_mm: float | None = None) -> PlaneImage:
    """Resample an image (H, W) to the plane, over the rectangle that the beads' hull spans there.

    `spacing_mm` of the new pixels; by default one old pixel's size in the middle. Raises UnusableInputError on a
    spacing that gives no image or a huge one, OutsideRegionError.
    """
    if spacing_mm is None:
        middle = hull.corners_px.mean(axis=0, keepdims=True)
        spacing_mm = float(np.sqrt(abs(np.linalg.det(plane_map.jacobian(middle)[0]))))
    corners_mm = plane_map.to_plane(hull.corners_px)
    origin, extent = corners_mm.min(axis=0), np.ptp(corners_mm, axis=0)
    if not (np.isfinite(spacing_mm) and spacing_mm > 0) or np.prod(extent / spacing_mm) > _MAX_PIXELS:
        raise UnusableInputError(f"a spacing of {spacing_mm} mm gives no image of a usable size; try 0.2")
    uv_px = _sources(plane_map, origin, extent, spacing_mm)
    return PlaneImage(
        pixels=cv2.remap(pixels, uv_px[..., 0].astype(np.float32), uv_px[..., 1].astype(np.float32), cv2.INTER_CUBIC),
        origin_mm=origin,
        spacing_mm=spacing_mm,
        uv_px=uv_px,
        inside_hull=hull.contains(uv_px.reshape(-1, 2)).reshape(uv_px.shape[:2]),
    )


def _sources(plane_map: PlaneMap, origin: np.ndarray, extent: np.ndarray, spacing_mm: float) -> np.ndarray:
    """(h, w, 2) pixels that the grid on the plane comes from."""
    x, y = (origin[k] + spacing_mm * np.arange(int(extent[k] / spacing_mm) + 1) for k in (0, 1))
    node_x, node_y = (np.linspace(a[0], a[-1], max(5, 1 + int(np.ptp(a) / _NODES_MM))) for a in (x, y))
    nodes = np.stack(np.meshgrid(node_x, node_y, indexing="ij"), axis=-1)
    uv = plane_map.to_image(nodes.reshape(-1, 2)).reshape(nodes.shape)
    return np.stack([RectBivariateSpline(node_x, node_y, uv[..., k])(x, y).T for k in (0, 1)], axis=-1)
