"""The exact inverse of a smooth plane map, by Newton's method."""

import numpy as np
from scipy.spatial import KDTree

from sightline.calibration.view import PlaneMap
from sightline.errors import OutsideRegionError

ITERATIONS = 30
TOLERANCE_PX = 1e-9
# How far beyond the controls' box a pixel may lie, in sizes of that box [ours]: a polynomial says nothing there.
REACH = 0.5


def invert(plane_map: PlaneMap, xy_mm: np.ndarray, controls_px: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) that `plane_map` takes to points (N, 2), starting at the nearest of the controls (M, 2).

    Raises OutsideRegionError where there is none near the controls.
    """
    target = np.asarray(xy_mm, dtype=np.float64)
    uv = controls_px[KDTree(plane_map.to_plane(controls_px)).query(target)[1]]
    low, high = controls_px.min(axis=0), controls_px.max(axis=0)
    margin = REACH * (high - low).max()
    limit = 0.25 * (high - low).max()
    step = np.full_like(uv, np.inf)
    for _ in range(ITERATIONS):
        step = _solve(plane_map.jacobian(uv), target - plane_map.to_plane(uv))
        length = np.linalg.norm(step, axis=1, keepdims=True)
        if not np.isfinite(step).all() or length.max(initial=0.0) < TOLERANCE_PX:
            break
        uv = uv + step * np.minimum(1.0, limit / np.maximum(length, 1e-300))
    lost = ~(np.linalg.norm(step, axis=1) < 1e-6) | (uv < low - margin).any(axis=1) | (uv > high + margin).any(axis=1)
    if lost.any():
        where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[lost][:3])
        raise OutsideRegionError(
            f"{lost.sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
            "choose points inside the beads' hull, or move the frame"
        )
    return uv


def _solve(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, 2) solutions of N systems of two equations; infinite where the map folds (determinant zero)."""
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    x, y = right.T
    det = a * d - b * c
    folded = np.abs(det) < 1e-9 * (a * a + b * b + c * c + d * d)
    det = np.where(folded, 1.0, det)
    out = np.stack([d * x - b * y, a * y - c * x], axis=1) / det[:, None]
    out[folded] = np.inf
    return out
