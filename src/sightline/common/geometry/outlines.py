"""Outlines: closed polygons in a plane."""

import numpy as np

from sightline.common.kernels import kernel


def centroids(outlines: np.ndarray) -> np.ndarray:
    """Return the centroids (N, 2) of the areas that outlines (N, K, 2) enclose, in their units."""
    return _centroids(np.ascontiguousarray(outlines, dtype=np.float64))


def enclosed_area(outline: np.ndarray) -> float:
    """Return the area that an outline (K, 2) encloses."""
    x, y = (outline - outline[0]).T  # from one of the corners: far from the origin the products would cancel
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def convex_hull(points: np.ndarray) -> np.ndarray:
    """Return the rows (C,) of the corners of the convex hull of points (N, 2), in order from x towards y.

    Points on a side are not corners; collinear points have two. Qhull opens a file for its messages each time.
    """
    order = np.lexsort(points.T[::-1])
    return order[_chain(np.ascontiguousarray(points[order], dtype=np.float64))]


@kernel()
def _chain(points):
    """Return the rows of the hull of points sorted by x and y: its lower side, then its upper side (Andrew 1979)."""
    n = len(points)
    corners, count = np.empty(2 * n + 1, np.int64), 0
    for side in range(2):
        first = count
        for k in range(n):
            i = k if side == 0 else n - 1 - k
            while count >= first + 2:
                a, b = points[corners[count - 2]], points[corners[count - 1]]
                if (b[0] - a[0]) * (points[i, 1] - a[1]) > (b[1] - a[1]) * (points[i, 0] - a[0]):
                    break
                count -= 1
            corners[count] = i
            count += 1
        count -= 1  # the last of a side is the first of the next
    return corners[:count]


@kernel()
def _centroids(outlines):
    centres = np.empty((len(outlines), 2))
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
        centres[n, 0], centres[n, 1] = x + moment_x / (3 * area), y + moment_y / (3 * area)
    return centres
