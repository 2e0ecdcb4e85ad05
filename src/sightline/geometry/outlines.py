"""Outlines: closed polygons in a plane."""

import numpy as np
from numba import njit


def centroids(outlines: np.ndarray) -> np.ndarray:
    """Return the centroids (N, 2) of the areas that outlines (N, K, 2) enclose, in their units."""
    return _centroids(np.ascontiguousarray(outlines, dtype=np.float64))


@njit(cache=True, error_model="numpy")
def _centroids(outlines):
    out = np.empty((len(outlines), 2))
    for n in range(len(outlines)):
        points, area, moment_x, moment_y, x, y = outlines[n], 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(points)):
            x, y = x + points[k, 0] / len(points), y + points[k, 1] / len(points)
        a, b = points[-1, 0] - x, points[-1, 1] - y
        for k in range(len(points)):
            c, d = points[k, 0] - x, points[k, 1] - y
            twice = a * d - b * c
            area, moment_x, moment_y = area + twice, moment_x + twice * (a + c), moment_y + twice * (b + d)
            a, b = c, d
        out[n, 0], out[n, 1] = x + moment_x / (3 * area), y + moment_y / (3 * area)
    return out
