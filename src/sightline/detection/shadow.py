"""The model of a window: shadows of one to three beads on a cubic background, and its least squares."""

import numba as nb
import numpy as np

from sightline.detection.profile import Q_COUNT, Q_STEP, T_COUNT, T_FIRST, T_STEP

# Per bead: u, v, radius, blur, ellipticity along the axes and along the diagonals. Then the light in the middle of a
# bead that comes from elsewhere (scatter), one for all beads of a window, and the background, of which the last four
# are cubic.
BEAD, GROUND, CUBIC = 6, 10, 4
# Of the light behind a dark bead the share that it takes away; what is seen in its middle is mostly scatter, which does
# not follow the background: 0.93-0.97 for 3 mm of steel; 0.87 leaves least of a background's slope in the centre, whose
# cubic part is damped [twin]. What a bright hole adds does not follow the background either.
TAKEN_BY_BALL, TAKEN_BY_HOLE = np.float32(0.87), np.float32(0.0)
FAST = {"reassoc", "contract", "arcp", "nsz"}  # all of fastmath that keeps NaN and infinity


@nb.njit(cache=True, fastmath=FAST)
def _profile_row(table, radius, blur, row):
    """Of the profile of this radius and blur, by its column: value, and derivative by blur over radius."""
    y = min(max(blur / radius / Q_STEP - 1.0, 0.0), Q_COUNT - 1.001)
    i = int(y)
    b = y - i
    for j in range(T_COUNT):
        row[0, j] = table[i, j] + (table[i + 1, j] - table[i, j]) * b
        row[1, j] = (table[i + 1, j] - table[i, j]) / Q_STEP


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _shadow(row, at, bead, out, slopes):
    """Derivatives of one bead's share by its six parameters into `out`; the share and its slopes into `slopes`."""
    u, v, radius, blur, e_axes, e_diagonals = bead.astype(np.float32)
    one, first, per_step = np.float32(1.0), np.float32(T_FIRST), np.float32(1.0 / T_STEP)
    last, radius2 = np.float32(T_COUNT - 1.001), blur / (radius * radius)
    for n in range(at.shape[1]):
        dx, dy = at[0, n] - u, at[1, n] - v
        r2 = dx * dx + dy * dy + np.float32(1e-6)
        r = np.sqrt(r2)
        axes, diagonals = (dx * dx - dy * dy) / r2, 2 * dx * dy / r2
        t = (r * (one - e_axes * axes - e_diagonals * diagonals) - radius) / blur
        x = min(max((t - first) * per_step, np.float32(0.0)), last)
        j = np.int32(x)
        w = x - np.float32(j)
        low, high = row[0, j], row[0, j + 1]
        by_q = row[1, j] + (row[1, j + 1] - row[1, j]) * w
        by_r = (high - low) * per_step / blur
        slopes[0, n] = low + (high - low) * w
        slopes[1, n], slopes[2, n] = by_r * dx / r, by_r * dy / r
        out[0, n], out[1, n] = -slopes[1, n], -slopes[2, n]
        out[2, n] = -by_r - by_q * radius2
        out[3, n] = by_q / radius - by_r * t
        out[4, n], out[5, n] = -by_r * r * axes, -by_r * r * diagonals


@nb.njit(cache=True, fastmath=FAST)
def fill_columns(table, at, beads, shine, ground, optics, columns):  # noqa: PLR0917
    """Derivatives of the model's light at the pixels, its residual, light and background, in this order.

    `at` (3, N): x, y, value seen; `shine`: the light from elsewhere; `optics`: one over the window's reach, the share
    that a bead takes away, and the squared blur that background and shadow went through together; `columns`
    (6K + 1 + GROUND + 3, N). Sharp, the light is G W + s (1 - V), where W and V are what the beads leave of either;
    blur over a slope of G moves the rim, to first order by blur² grad G grad W.
    """
    count, first, pixels = len(beads), BEAD * len(beads), at.shape[1]
    scale, taken, blur2 = optics[0], optics[1], optics[2] * optics[0]
    one, g = np.float32(1.0), ground.astype(np.float32)
    row, slopes = np.empty((2, T_COUNT), np.float32), np.empty((count, 3, pixels), np.float32)
    left, left_x, left_y, clear = np.empty((4, pixels), np.float32)
    left[:], left_x[:], left_y[:], clear[:] = one, 0.0, 0.0, one
    bright = columns[first + GROUND + 3]
    for n in range(pixels):
        a, b = at[0, n] * scale, at[1, n] * scale
        low = g[0] + a * (g[1] + a * (g[3] + a * g[6])) + b * (g[2] + b * (g[5] + b * g[9]))
        bright[n] = low + a * b * (g[4] + a * g[7] + b * g[8])
    for k in range(count):
        _profile_row(table, beads[k, 2], beads[k, 3], row)
        _shadow(row, at, beads[k], columns[BEAD * k : BEAD * k + BEAD], slopes[k])
        for n in range(pixels):
            left[n] *= one - taken * slopes[k, 0, n]
            clear[n] *= one - slopes[k, 0, n]
    for k in range(count):
        others_left, others_clear = np.ones(pixels, np.float32), np.ones(pixels, np.float32)
        for m in range(count):
            if m != k:
                for n in range(pixels):
                    others_left[n] *= one - taken * slopes[m, 0, n]
                    others_clear[n] *= one - slopes[m, 0, n]
        for n in range(pixels):
            left_x[n] -= blur2 * taken * slopes[k, 1, n] * others_left[n]
            left_y[n] -= blur2 * taken * slopes[k, 2, n] * others_left[n]
            others_clear[n] = shine * others_clear[n] - taken * bright[n] * others_left[n]
        for m in range(BEAD):
            for n in range(pixels):
                columns[BEAD * k + m, n] *= others_clear[n]
    for n in range(pixels):
        columns[first, n] = one - clear[n]
        columns[first + GROUND + 2, n] = shine * columns[first, n]
    _background(at, scale, g, left, left_x, left_y, columns[first + 1 :])


@nb.njit(cache=True, fastmath=FAST)
def _background(at, scale, g, left, left_x, left_y, columns):  # noqa: PLR0917
    """Columns of the background behind what the beads leave; its light is added to theirs, and the residual taken."""
    rest, light = columns[GROUND], columns[GROUND + 1]
    for n in range(at.shape[1]):
        a, b, w, x, y = at[0, n] * scale, at[1, n] * scale, left[n], left_x[n], left_y[n]
        aa, ab, bb = a * a, a * b, b * b
        columns[0, n], columns[1, n], columns[2, n] = w, w * a + x, w * b + y
        columns[3, n], columns[4, n] = w * aa + 2 * a * x, w * ab + b * x + a * y
        columns[5, n], columns[6, n] = w * bb + 2 * b * y, w * aa * a + 3 * aa * x
        columns[7, n] = w * aa * b + 2 * ab * x + aa * y
        columns[8, n] = w * ab * b + bb * x + 2 * ab * y
        columns[9, n] = w * bb * b + 3 * bb * y
    for m in range(GROUND):
        for n in range(at.shape[1]):
            light[n] += g[m] * columns[m, n]
    for n in range(at.shape[1]):
        rest[n] = at[2, n] - light[n]


@nb.njit(cache=True, fastmath=True)
def normal_equations(columns, A, b):
    """A = J'J, b = J'r of the first len(b) columns and the one after them; the sum of r²."""
    n, pixels = len(b) + 1, columns.shape[1]
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
    return substitute(L, b, x)


@nb.njit(cache=True, fastmath=FAST)
def substitute(L, b, x):
    """Solve L L' x = b."""
    n = len(b)
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
