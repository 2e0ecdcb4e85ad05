"""The model of a sharpened window: shadows of one to three beads on a cubic background, and its least squares."""

import numba as nb
import numpy as np

from sightline.detection.profile import Q_COUNT, Q_STEP, T_COUNT, T_FIRST, T_STEP

# Per bead: u, v, radius, opacity (share of the light taken away in the middle), blur. Then the background.
BEAD, GROUND, CUBIC = 5, 10, 4  # the last four of the background are cubic
FAST = {"reassoc", "contract", "arcp", "nsz"}  # all of fastmath that keeps NaN and infinity


@nb.njit(cache=True, fastmath=FAST)
def profile(table, r, radius, blur):
    """Profile at distance `r`, and its derivatives by r, radius and blur."""
    t = (r - radius) / blur
    if t >= T_FIRST + (T_COUNT - 1.001) * T_STEP:
        return 0.0, 0.0, 0.0, 0.0
    x = max((t - T_FIRST) / T_STEP, 0.0)
    y = min(max(blur / radius / Q_STEP - 1.0, 0.0), Q_COUNT - 1.001)
    i, j = int(y), int(x)
    b, a = y - i, x - j
    p00, p01, p10, p11 = table[i, j], table[i, j + 1], table[i + 1, j], table[i + 1, j + 1]
    low, high = p00 + (p01 - p00) * a, p10 + (p11 - p10) * a
    by_t = ((p01 - p00) * (1 - b) + (p11 - p10) * b) / T_STEP if t > T_FIRST else 0.0
    by_q = (high - low) / Q_STEP
    by_r = by_t / blur
    return low + (high - low) * b, by_r, -by_r - by_q * blur / radius**2, -by_r * t + by_q / radius


@nb.njit(cache=True, fastmath=FAST)
def ground_light(g, a, b):
    """The background at (a, b), in units of the window's reach: a cubic."""
    first = g[0] + a * (g[1] + a * (g[3] + a * g[6])) + b * (g[2] + b * (g[5] + b * g[9]))
    return first + a * b * (g[4] + a * g[7] + b * g[8])


@nb.njit(cache=True, fastmath=FAST)
def fill_columns(table, at, beads, ground, scale, root, columns):  # noqa: PLR0917
    """Residual (last row) and derivatives of the model at the pixels, each divided by the noise's deviation.

    `at` (3, N): x, y, sharpened value; `root` (N,): one over the deviation; `columns` (5K + GROUND + 1, N).
    The light behind several beads is what each leaves of the other's, above what none of them stops (scatter).
    """
    count = len(beads)
    most = beads[0, 3]
    for k in range(1, count):
        if abs(beads[k, 3]) > abs(most):
            most = beads[k, 3]
    first = BEAD * count
    for p in range(at.shape[1]):
        x, y = at[0, p], at[1, p]
        a, b = x * scale, y * scale
        bright = ground_light(ground, a, b)
        weight = root[p]
        left = 1.0
        for k in range(count):
            dx, dy = x - beads[k, 0], y - beads[k, 1]
            r = np.sqrt(dx * dx + dy * dy) + 1e-6
            d, by_r, by_radius, by_blur = profile(table, r, beads[k, 2], beads[k, 4])
            unit = weight * bright
            strength = unit * beads[k, 3]
            columns[BEAD * k, p] = strength * by_r * dx / r
            columns[BEAD * k + 1, p] = strength * by_r * dy / r
            columns[BEAD * k + 2, p] = -strength * by_radius
            columns[BEAD * k + 3, p] = -unit * d
            columns[BEAD * k + 4, p] = -strength * by_blur
            if count > 1:
                light = 1.0 - beads[k, 3] * d / most
                for m in range(first):
                    if m // BEAD < k:
                        columns[m, p] *= light
                    elif m // BEAD == k:
                        columns[m, p] *= left
                left *= light
            else:
                left = 1.0 - d
        light = 1.0 - most * (1.0 - left)
        unit = weight * light
        columns[first, p] = unit
        columns[first + 1, p] = unit * a
        columns[first + 2, p] = unit * b
        columns[first + 3, p] = unit * a * a
        columns[first + 4, p] = unit * a * b
        columns[first + 5, p] = unit * b * b
        columns[first + 6, p] = unit * a * a * a
        columns[first + 7, p] = unit * a * a * b
        columns[first + 8, p] = unit * a * b * b
        columns[first + 9, p] = unit * b * b * b
        columns[first + 10, p] = weight * (at[2, p] - bright * light)


@nb.njit(cache=True, fastmath=True)
def normal_equations(columns, A, b):
    """A = J'J, b = J'r of the columns; the sum of r²."""
    n, pixels = columns.shape
    for i in range(n):
        for j in range(i + 1):
            s = np.float32(0.0)
            for p in range(pixels):
                s += columns[i, p] * columns[j, p]
            if i < n - 1:
                A[i, j] = s
                A[j, i] = s
            elif j < n - 1:
                b[j] = s
            else:
                return s
    return np.float32(0.0)


@nb.njit(cache=True, fastmath=FAST)
def solve(A, b, L, x):
    """Solve A x = b for symmetric A by Cholesky (`L` is room for it); False if A is not positive."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s <= 1e-7 * A[i, i] or s <= 0:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True
