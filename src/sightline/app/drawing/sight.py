"""A compact map of a calibrated view, from which the browser draws image-matching curves without the server."""

from typing import Any

import numpy as np

from sightline.calibration import BeadView
from sightline.calibration.maps.hull import MAX_OUTSIDE

NODES = 33  # per axis: cubic interpolation between them agrees with the map to 0.02 px (tests) [ours]
_PAD = 2  # nodes beyond the region, for interpolation at its border
_ROUNDED_MM, _ROUNDED_PX = 5, 4  # decimals


def sight(view: BeadView, image_shape: tuple[int, int]) -> dict[str, Any]:
    """Return the map of a view (`Sight` in xray_sight.js) as JSON types.

    `focal`, `origin`, `axes`, mm: focal point and reference plane. `toPlane`: grid from pixels to the plane, `toImage`:
    grid from the plane to pixels, null where there is none; both cover the image as far as the view is calibrated:
    where the distance from all `sides` (normal, offset) of the beads' convex hull is at most `reach`, px.
    """
    hull = view.hull
    reach = MAX_OUTSIDE * hull.radius_px
    low = np.maximum(hull.corners_px.min(axis=0) - reach, -0.5)
    high = np.minimum(hull.corners_px.max(axis=0) + reach, np.array(image_shape[::-1]) - 0.5)
    pixels = _Grid(low, high)
    xy = view.plane_map.to_plane(pixels.nodes)
    near = xy[hull.is_near(pixels.nodes)]
    shadows = _Grid(near.min(axis=0), near.max(axis=0))
    uv = np.full((len(shadows.nodes), 2), np.nan)
    found_px, found = view.plane_map.find_image(shadows.nodes)
    uv[found] = found_px
    return {
        "focal": view.focal_point_mm.tolist(),
        "origin": view.plane.origin_mm.tolist(),
        "axes": view.plane.axes.tolist(),
        "toPlane": pixels.document(xy, _ROUNDED_MM),
        "toImage": shadows.document(uv, _ROUNDED_PX),
        "sides": hull.equations.tolist(),
        "reach": reach,
    }


class _Grid:
    """NODES x NODES nodes evenly over a rectangle, and _PAD more beyond each side. `nodes` (N, 2): row by row."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.step = (high - low) / (NODES - 1)
        self.start = low - _PAD * self.step
        self.count = NODES + 2 * _PAD
        x, y = (self.start[k] + self.step[k] * np.arange(self.count) for k in range(2))
        self.nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def document(self, values: np.ndarray, decimals: int) -> dict[str, Any]:
        """Return values (N, 2) at the nodes as JSON types."""
        known = [None if np.isnan(pair[0]) else pair.round(decimals).tolist() for pair in values]
        return {"start": self.start.tolist(), "step": self.step.tolist(), "count": self.count, "values": known}
