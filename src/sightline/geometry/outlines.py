"""Outlines: closed polygons in a plane."""

import numpy as np


def centroids(outlines: np.ndarray) -> np.ndarray:
    """Return the centroids (N, 2) of the areas that outlines (N, K, 2) enclose, in their units."""
    middle = outlines.mean(axis=1, keepdims=True)
    a, b = outlines - middle, np.roll(outlines, -1, axis=1) - middle
    twice_area = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    moment = (twice_area[..., None] * (a + b)).sum(axis=1) / (3 * twice_area.sum(axis=1)[:, None])
    return middle[:, 0] + moment
