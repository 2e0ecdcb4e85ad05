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
    """Derivatives of one bead's share by its six parameters into `out`; the share and its slopes into `slopes`.

    In several short loops, each of which the compiler vectorises.
    """
    u, v, radius, blur = np.float32(bead[0]), np.float32(bead[1]), np.float32(bead[2]), np.float32(bead[3])
    e_axes, e_diagonals = np.float32(bead[4]), np.float32(bead[5])
    one, first, per_step, last = np.float32(1.0), np.float32(T_FIRST), np.float32(1.0 / T_STEP), np.float32(T_COUNT)
    last -= np.float32(1.001)
    per_blur, per_radius, pixels = one / blur, one / radius, at.shape[1]
    r, t, by_r, by_q = out[2], out[3], out[4], out[5]
    for n in range(pixels):
        dx, dy = at[0, n] - u, at[1, n] - v
        r[n] = np.sqrt(dx * dx + dy * dy + np.float32(1e-6))
        c, s = dx / r[n], dy / r[n]
        out[0, n], out[1, n] = c, s
        t[n] = (r[n] * (one - e_axes * (c * c - s * s) - e_diagonals * (2 * c * s)) - radius) * per_blur
    for n in range(pixels):
        x = min(max((t[n] - first) * per_step, np.float32(0.0)), last)
        w = x - np.float32(np.int32(x))
        j = np.uint32(np.int32(x))
        low, high = row[0, j], row[0, j + np.uint32(1)]
        by_r[n] = (high - low) * per_step * per_blur
        slopes[0, n] = low + (high - low) * w
        low, high = row[1, j], row[1, j + np.uint32(1)]
        by_q[n] = low + (high - low) * w
    for n in range(pixels):
        c, s, f, q = out[0, n], out[1, n], by_r[n], by_q[n]
        slopes[1, n], slopes[2, n] = f * c, f * s
        out[0, n], out[1, n] = -f * c, -f * s
        g = f * r[n]
        out[2, n] = -f - q * blur * per_radius * per_radius
        out[3, n] = q * per_radius - f * t[n]
        out[4, n], out[5, n] = -g * (c * c - s * s), -g * (2 * c * s)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def fill_columns(table, at, beads, shine, ground, optics, columns):  # noqa: PLR0917
    """Derivatives of the model's light at the pixels, its residual, light and background, in this order.

    `at` (3, N): x, y, value seen; `shine`: the light from elsewhere; `optics`: one over the window's reach, the share
    that a bead takes away, and the squared blur that background and shadow went through together; `columns`
    (6K + 1 + GROUND + 3, N). Sharp, the light is G W + s (1 - V), where W and V are what the beads leave of either;
    blur over a slope of G moves the rim, to first order by blur² grad G grad W.
    """
    count, first, pixels = len(beads), BEAD * len(beads), at.shape[1]
    taken, blur2, one = optics[1], optics[2] * optics[0], np.float32(1.0)
    row, slopes = np.empty((2, T_COUNT), np.float32), np.empty((count, 3, pixels), np.float32)
    left, clear = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    left_x, left_y = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    others_left, others_clear = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    bright = columns[first + GROUND + 3]
    _ground(at, optics[0], ground, bright)
    left[:], clear[:], left_x[:], left_y[:] = one, one, 0.0, 0.0
    for k in range(count):
        _profile_row(table, beads[k, 2], beads[k, 3], row)
        _shadow(row, at, beads[k], columns[BEAD * k : BEAD * k + BEAD], slopes[k])
        for n in range(pixels):
            left[n] *= one - taken * slopes[k, 0, n]
            clear[n] *= one - slopes[k, 0, n]
    for k in range(count):
        others_left[:], others_clear[:] = one, one
        for m in range(count):
            if m != k:
                for n in range(pixels):
                    others_left[n] *= one - taken * slopes[m, 0, n]
                    others_clear[n] *= one - slopes[m, 0, n]
        for n in range(pixels):
            left_x[n] -= blur2 * taken * slopes[k, 1, n] * others_left[n]
            left_y[n] -= blur2 * taken * slopes[k, 2, n] * others_left[n]
            others_clear[n] = shine * others_clear[n] - taken * bright[n] * others_left[n]
        for m in range(BEAD * k, BEAD * k + BEAD):
            for n in range(pixels):
                columns[m, n] *= others_clear[n]
    for n in range(pixels):
        columns[first, n] = one - clear[n]
        columns[first + GROUND + 2, n] = shine * columns[first, n]
    _background(at, optics[0], ground, left, left_x, left_y, columns[first + 1 :])


@nb.njit(cache=True, fastmath=FAST)
def _ground(at, scale, ground, bright):
    """The light of the background at the pixels `at`."""
    g0, g1, g2 = np.float32(ground[0]), np.float32(ground[1]), np.float32(ground[2])
    g3, g4, g5 = np.float32(ground[3]), np.float32(ground[4]), np.float32(ground[5])
    g6, g7, g8, g9 = np.float32(ground[6]), np.float32(ground[7]), np.float32(ground[8]), np.float32(ground[9])
    for n in range(at.shape[1]):
        a, b = at[0, n] * scale, at[1, n] * scale
        low = g0 + a * (g1 + a * (g3 + a * g6)) + b * (g2 + b * (g5 + b * g9))
        bright[n] = low + a * b * (g4 + a * g7 + b * g8)


@nb.njit(cache=True, fastmath=FAST)
def _background(at, scale, ground, left, left_x, left_y, columns):  # noqa: PLR0917
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
        share = np.float32(ground[m])
        for n in range(at.shape[1]):
            light[n] += share * columns[m, n]
    for n in range(at.shape[1]):
        rest[n] = at[2, n] - light[n]


@nb.njit(cache=True, fastmath=True)
def normal_equations(columns, A, b):
    """A = J'J, b = J'r of the first len(b) columns and the one after them, an even number; the sum of r²."""
    n = len(b)
    for i in range(0, n + 1, 2):
        for j in range(0, i + 1, 2):
            ii = ij = ji = jj = np.float32(0.0)
            for p in range(columns.shape[1]):  # four sums at once: half the loads
                f, g = columns[i, p], columns[i + 1, p]
                ii += f * columns[j, p]
                ij += f * columns[j + 1, p]
                ji += g * columns[j, p]
                jj += g * columns[j + 1, p]
            A[j, i] = A[i, j] = ii
            if i + 1 < n:
                A[j + 1, i] = A[i, j + 1] = ij
                A[j, i + 1] = A[i + 1, j] = ji
                A[j + 1, i + 1] = A[i + 1, j + 1] = jj
            elif j + 1 < n:
                A[j + 1, i] = A[i, j + 1] = ij
                b[j], b[j + 1] = ji, jj
            else:
                b[j] = ji
                return jj
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
