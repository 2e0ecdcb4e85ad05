"""The exact inverse of a smooth plane map, by Newton's method."""

import numpy as np

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
    images = plane_map.to_plane(controls_px)
    nearest = ((target[:, None] - images[None]) ** 2).sum(axis=-1).argmin(axis=1)
    uv = controls_px[nearest]
    low, high = controls_px.min(axis=0), controls_px.max(axis=0)
    margin = REACH * (high - low).max()
    limit = 0.25 * (high - low).max()
    step = np.full_like(uv, np.inf)
    for _ in range(ITERATIONS):
        step = np.linalg.solve(plane_map.jacobian(uv), (target - plane_map.to_plane(uv))[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        uv = uv + step * np.minimum(1.0, limit / np.maximum(length, 1e-300))
        if not np.isfinite(uv).all() or length.max(initial=0.0) < TOLERANCE_PX:
            break
    lost = ~(np.linalg.norm(step, axis=1) < 1e-6) | (uv < low - margin).any(axis=1) | (uv > high + margin).any(axis=1)
    if lost.any():
        where = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in target[lost][:3])
        raise OutsideRegionError(
            f"{lost.sum()} points lie outside the region the beads calibrate (plane coordinates {where} mm); "
            "choose points inside the beads' hull, or move the frame"
        )
    return uv
