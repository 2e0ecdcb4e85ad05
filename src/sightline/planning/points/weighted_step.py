"""The weighted Gauss-Newton step of points towards their lines of sight, as `Solution.step_mm`, in kernels.

A page computes it at each move of a dragged point. Every array is small: as calls of NumPy a step takes ten times as
long.
"""

import numpy as np

from sightline.common.kernels import kernel


@kernel(nogil=True)
def weighted_step(xyz, planes, xy, seen, focal, first, total, picks, snapped):  # noqa: PLR0917 - a kernel
    """Move points `xyz` (N, 3) by one step. Return False where a point is behind a focal point, or a covariance is
    singular.

    `planes` (V, 5, 3): of each view origin, axes and normal of its plane, and its pencil; `xy` (V, N, 2): the lines;
    `focal` (V,) and `first` (V, N): places of the focal point's and of the lines' numbers in `total` (Z, Z), their
    covariance; `picks` (N, 2V, 2V); `snapped` (V, N, 2V): directions in which a pick measures nothing.
    """
    views, count = seen.shape
    size = 2 * views
    slope, by_focal, residual = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros(size)
    for i in range(count):
        place, base, own, rows = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64), 0
        for v in range(views):
            if not seen[v, i]:
                continue
            if not _residual(xyz[i], planes[v], xy[v, i], slope[rows:], by_focal[rows:], residual[rows:]):
                return False
            for a in range(2):
                place[rows], base[rows], own[rows] = first[v, i] + a, focal[v], 2 * v + a
                rows += 1
        own = own[:rows]
        information = _covariance(total, picks[i], by_focal, place, base, own)
        if not _invert(information):
            return False
        for v in range(views):
            _take_out(information, snapped[v, i], own)
        if not _move(xyz[i], slope[:rows], information, residual[:rows]):
            return False
    return True


@kernel(nogil=True)
def _residual(point, view, line, slope, by_focal, residual):  # noqa: PLR0917 - a kernel
    """Set what `LineResiduals` holds of a point (3,) in a view (5, 3): both residuals (2,), and the derivatives (2, 3)
    of its shadow by the point and of its residuals by the focal point. Return whether it casts a shadow."""
    origin, normal, pencil = view[0], view[3], view[4]
    height = 0.0
    for c in range(3):
        height += (point[c] - origin[c]) * normal[c]
    depth = 1.0 - height * pencil[2]
    if not depth > 0.0:
        return False
    for a in range(2):
        along = 0.0
        for c in range(3):
            along += (point[c] - origin[c]) * view[1 + a, c]
        shadow = (along - height * pencil[a]) / depth
        residual[a] = line[a] - shadow
        lift = pencil[2] * shadow - pencil[a]
        for c in range(3):
            slope[a, c] = (view[1 + a, c] + lift * normal[c]) / depth
            by_focal[a, c] = (1.0 - depth) * slope[a, c]
    return True


@kernel(nogil=True)
def _covariance(total, picks, by_focal, place, base, own):  # noqa: PLR0917 - a kernel
    """Return the covariance (n, n) of a point's residuals: of its lines, of the focal points, and of its picks."""
    rows = len(own)
    covariance = np.empty((rows, rows))
    for p in range(rows):
        for q in range(rows):
            value = total[place[p], place[q]] + picks[own[p], own[q]]
            for c in range(3):
                value += by_focal[p, c] * total[base[p] + c, place[q]] + by_focal[q, c] * total[place[p], base[q] + c]
                for d in range(3):
                    value += by_focal[p, c] * total[base[p] + c, base[q] + d] * by_focal[q, d]
            covariance[p, q] = value
    return covariance


@kernel(nogil=True)
def _take_out(information, direction, own):
    """Set the information (n, n) to that in the limit of infinite variance in a direction; none where it is zero."""
    rows = len(own)
    carried, weight = np.zeros(rows), 0.0
    for p in range(rows):
        for q in range(rows):
            carried[p] += information[p, q] * direction[own[q]]
        weight += direction[own[p]] * carried[p]
    if weight > 0.0:
        for p in range(rows):
            for q in range(rows):
                information[p, q] -= carried[p] * carried[q] / weight


@kernel(nogil=True)
def _move(point, slope, information, residual):
    """Move a point (3,) by the least-squares step; return False where its residuals (n,) do not determine it."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for c in range(3):
        for q in range(len(residual)):
            weight = 0.0
            for p in range(len(residual)):
                weight += slope[p, c] * information[p, q]
            right[c] += weight * residual[q]
            for d in range(3):
                normal[c, d] += weight * slope[q, d]
    if not _invert(normal):
        return False
    for c in range(3):
        for d in range(3):
            point[c] += normal[c, d] * right[d]
    return True


@kernel(nogil=True)
def _invert(matrix):
    """Replace a symmetric positive definite matrix (n, n) by its inverse; return whether it has one."""
    n = len(matrix)
    for k in range(n):
        pivot = matrix[k, k]
        if not pivot > 0.0:
            return False
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] /= pivot
        for i in range(n):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(n):
                    matrix[i, j] -= factor * matrix[k, j]
    return True
