"""Sub-pixel beads: a blurred disc or ball on a quadratic background, fitted to log intensity, weighted for noise."""

import numba as nb
import numpy as np

from sightline.detection.noise import NoiseModel
from sightline.detection.profile import Q_COUNT, Q_STEP, T_COUNT, T_FIRST, T_STEP, profile_table

# Parameters of a fit: u, v, radius, contrast, blur, then the background's 1, x, y, x², xy, y² in window units.
_SHAPE, _N = 5, 11
# Columns of the answer: those five, then covariance of the centre, variance of the contrast, chi-square per pixel,
# residual rms, weakest sector's contrast in units of the whole's, mean residual in the middle, status,
# number of pixels, mean variance that the noise model expects of them.
U, V, RADIUS, CONTRAST, BLUR, CUU, CUV, CVV, CCC, CHI2, MISFIT, WEAKEST, HOLLOW, STATUS, PIXELS, NOISE = range(16)
FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = 0, 1, 2, 3
_LEAST_BLUR = 0.35  # px; a pixel alone blurs as much
_STEPS = 25
_WEIGHTED_STEPS = 3
_ENOUGH = 250  # pixels for a coarse fit; of a wider window every second, third ... along the rows [ours]
_FAST = {"reassoc", "contract", "arcp", "nsz"}  # all of fastmath that keeps NaN and infinity
_PRIOR_PIXELS = 50.0  # weight of the image's noise model against the bead's own residuals, in pixels [ours]


def fit_coarsely(
    log_image: np.ndarray, usable: np.ndarray, spots: np.ndarray, others: np.ndarray, noise: NoiseModel
) -> np.ndarray:
    """Least-squares fit of every spot, all pixels alike: (M, NOISE + 1), to tell beads from what is none.

    `log_image` (H, W) float32; `usable` (H, W) bool; `spots` (M, 4) of u, v, radius, response;
    `others` (K, 4) likewise: discs that a window leaves out where they are not the spot itself, nor much weaker.
    """
    tables = profile_table(ball=True), profile_table(ball=False)
    return _coarse(log_image, usable, spots, others, noise.offset, noise.slope, *tables)


def fit_finely(
    log_image: np.ndarray, usable: np.ndarray, coarse: np.ndarray, others: np.ndarray, noise: NoiseModel
) -> np.ndarray:
    """From each row of `coarse` a fit weighted for correlated noise: the same columns, covariance included."""
    tables = profile_table(ball=True), profile_table(ball=False)
    return _fine(
        log_image, usable, coarse, others, noise.offset, noise.slope, noise.weighting, noise.correlation, *tables
    )


@nb.njit(parallel=True, cache=True, fastmath=_FAST)
def _coarse(image, usable, spots, others, offset, slope, ball, disc):  # noqa: PLR0917
    out = np.zeros((len(spots), NOISE + 1))
    for i in nb.prange(len(spots)):
        _fit_coarse(image, usable, others, spots[i], ball if spots[i, 3] < 0 else disc, offset, slope, out[i])
    return out


@nb.njit(parallel=True, cache=True, fastmath=_FAST)
def _fine(image, usable, coarse, others, offset, slope, weighting, correlation, ball, disc):  # noqa: PLR0917
    out = coarse.copy()
    for i in nb.prange(len(coarse)):
        table = ball if coarse[i, CONTRAST] < 0 else disc
        _fit_fine(image, usable, others, table, offset, slope, weighting, correlation, out[i])
    return out


@nb.njit(cache=True, fastmath=_FAST)
def _profile(table, r, radius, blur):
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


@nb.njit(cache=True, fastmath=_FAST)
def _model(table, p, x, y, scale, gradient):  # noqa: PLR0917
    """Log intensity at (x, y) and its background; the derivatives by the parameters go into `gradient`."""
    dx, dy = x - p[U], y - p[V]
    r = np.sqrt(dx * dx + dy * dy) + 1e-9
    d, d_r, d_radius, d_blur = _profile(table, r, p[RADIUS], p[BLUR])
    left = np.exp(p[CONTRAST])
    through = 1.0 - (1.0 - left) * d
    by_d = -(1.0 - left) / through
    gradient[U] = -by_d * d_r * dx / r
    gradient[V] = -by_d * d_r * dy / r
    gradient[RADIUS] = by_d * d_radius
    gradient[CONTRAST] = left * d / through
    gradient[BLUR] = by_d * d_blur
    a, b = x * scale, y * scale
    gradient[5], gradient[6], gradient[7], gradient[8], gradient[9], gradient[10] = 1.0, a, b, a * a, a * b, b * b
    background = p[5] + a * (p[6] + p[8] * a + p[9] * b) + b * (p[7] + p[10] * b)
    return background + np.log(through), background


@nb.njit(cache=True, fastmath=_FAST)
def _solve(A, b, damping, x):
    """Solve (A + damping diag A) x = b for symmetric A by Cholesky; False if A is not positive."""
    n = len(b)
    L = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            if i == j:
                s += damping * A[i, i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s <= 1e-12 * A[i, i] or s <= 0:
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


@nb.njit(cache=True)
def _window(usable, others, u, v, radius, contrast, half):  # noqa: PLR0917
    """Left and top of the square window, and which of its pixels may be used."""
    height, width = usable.shape
    left, top = max(int(u) - half, 0), max(int(v) - half, 0)
    right, bottom = min(int(u) + half + 2, width), min(int(v) + half + 2, height)
    mask = usable[top:bottom, left:right].copy()
    for k in range(len(others)):
        reach = others[k, 2] + 2.5
        x, y = others[k, 0] - left, others[k, 1] - top
        if x + reach < 0 or y + reach < 0 or x - reach > right - left or y - reach > bottom - top:
            continue
        if (others[k, 0] - u) ** 2 + (others[k, 1] - v) ** 2 < (0.8 * max(radius, others[k, 2])) ** 2:
            continue  # the spot itself
        if abs(others[k, 3]) < 0.5 * abs(contrast):
            continue  # structure about the bead, not another
        for i in range(max(0, int(y - reach)), min(bottom - top, int(y + reach) + 2)):
            for j in range(max(0, int(x - reach)), min(right - left, int(x + reach) + 2)):
                if (i - y) ** 2 + (j - x) ** 2 < reach * reach:
                    mask[i, j] = False
    return left, top, mask


@nb.njit(cache=True, fastmath=_FAST)
def _gather(image, mask, left, top, u, v, reach, stride):  # noqa: PLR0917
    """Usable pixels within `reach` of (u, v): their x, y from there and their value."""
    found = np.empty((mask.size, 3))
    n = 0
    for i in range(mask.shape[0]):
        y = top + i - v
        for j in range(i % stride, mask.shape[1], stride):
            x = left + j - u
            if mask[i, j] and x * x + y * y < reach * reach:
                found[n, 0], found[n, 1], found[n, 2] = x, y, image[top + i, left + j]
                n += 1
    return found[:n]


@nb.njit(cache=True, fastmath=_FAST)
def _fit_coarse(image, usable, others, spot, table, offset, slope, out):  # noqa: PLR0917
    u, v, radius = spot[0], spot[1], spot[2]
    out[U], out[V], out[RADIUS] = u, v, radius
    out[CONTRAST] = spot[3]
    reach = 1.5 * radius + 3.0
    left, top, mask = _window(usable, others, u, v, radius, out[CONTRAST], int(reach) + 1)
    pixels = _gather(image, mask, left, top, u, v, reach, 1 + int(3.2 * reach * reach / _ENOUGH))
    if len(pixels) < 2 * _N:
        out[STATUS] = TOO_FEW_PIXELS
        return
    p = np.zeros(_N)
    p[RADIUS], p[CONTRAST], p[BLUR] = radius, out[CONTRAST], min(1.2, 0.4 * radius)
    p[_SHAPE] = _surroundings(pixels, radius)
    out[STATUS] = _descend(pixels, table, p, radius, reach)
    out[PIXELS] = len(pixels)
    if out[STATUS] == FITTED:
        out[:_SHAPE] = p[:_SHAPE]
        out[U] += u
        out[V] += v
        _judge(pixels, table, p, 1.0 / reach, offset, slope, out)


@nb.njit(cache=True, fastmath=_FAST)
def _descend(pixels, table, p, radius, reach):
    """Levenberg-Marquardt on `p`; the status."""
    gradient, step, trial = np.empty(_N), np.zeros(_N), p.copy()
    A, b = np.empty((_N, _N)), np.empty(_N)
    A_best, b_best = np.empty((_N, _N)), np.empty(_N)
    damping, best = 1e-3, 1e300
    for _ in range(_STEPS):
        A[:] = 0.0
        b[:] = 0.0
        total = 0.0
        for i in range(len(pixels)):
            m, _ground = _model(table, trial, pixels[i, 0], pixels[i, 1], 1.0 / reach, gradient)
            residual = pixels[i, 2] - m
            total += residual * residual
            for k in range(_N):
                b[k] += gradient[k] * residual
                for j in range(k + 1):
                    A[k, j] += gradient[k] * gradient[j]
        if total <= best:
            settled = total > best * (1 - 1e-3)
            best, damping = total, damping * 0.1
            p[:] = trial
            A_best[:], b_best[:] = A, b
            if settled:
                return FITTED
        else:
            damping = max(damping * 30, 1e-3)
        if damping > 1e4 or not _solve(A_best, b_best, damping + 1e-9, step):
            return SINGULAR
        for k in range(_N):
            trial[k] = p[k] + step[k]
        trial[RADIUS] = min(max(trial[RADIUS], 0.6 * p[RADIUS]), 1.6 * p[RADIUS])
        trial[BLUR] = min(max(trial[BLUR], _LEAST_BLUR, 0.5 * p[BLUR]), 2 * p[BLUR], trial[RADIUS])
        trial[CONTRAST] = min(max(trial[CONTRAST], -6.0), 4.0)
        if trial[U] ** 2 + trial[V] ** 2 > (0.6 * radius + 1) ** 2 or not 0.45 * radius < trial[RADIUS] < 1.9 * radius:
            return WANDERED
    return FITTED


@nb.njit(cache=True, fastmath=_FAST)
def _judge(pixels, table, p, scale, offset, slope, out):  # noqa: PLR0917
    """How well the bead explains its window: residual, weakest sector, how hollow."""
    gradient = np.empty(_N)
    seen, meant = np.zeros(8), np.zeros(8)
    residuals, hollow, middle, noise = 0.0, 0.0, 1e-9, 0.0
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        m, ground = _model(table, p, x, y, scale, gradient)
        residual = pixels[i, 2] - m
        residuals += residual * residual
        noise += np.exp(offset - slope * m)
        bead = m - ground
        sector = int((np.arctan2(y - p[V], x - p[U]) / (2 * np.pi) + 1.0) * 8) % 8
        seen[sector] += (residual + bead) * bead
        meant[sector] += bead * bead
        if (x - p[U]) ** 2 + (y - p[V]) ** 2 < (0.4 * p[RADIUS]) ** 2:
            hollow += residual
            middle += 1
    out[MISFIT] = np.sqrt(residuals / len(pixels))
    out[NOISE] = noise / len(pixels)
    out[WEAKEST] = 1.0
    for k in range(8):
        if meant[k] > meant.sum() / 32:  # a sector that a neighbour covers says nothing
            out[WEAKEST] = min(out[WEAKEST], seen[k] / meant[k])
    out[HOLLOW] = hollow / middle


@nb.njit(cache=True, fastmath=_FAST)
def _fit_fine(image, usable, others, table, offset, slope, weighting, correlation, out):  # noqa: PLR0917
    """From a coarse fit: a closer window, least squares again, then Gauss-Newton steps weighted for the noise."""
    u, v, radius = out[U], out[V], out[RADIUS]
    reach = radius + max(3.0 * out[BLUR], 0.3 * radius) + 1.5
    left, top, mask = _window(usable, others, u, v, radius, out[CONTRAST], int(reach) + 1)
    pixels = _gather(image, mask, left, top, u, v, reach, 1 + int(3.2 * reach * reach / (2 * _ENOUGH)))
    if len(pixels) < 2 * _N:
        out[STATUS] = TOO_FEW_PIXELS
        return
    p = np.zeros(_N)
    p[RADIUS], p[CONTRAST], p[BLUR] = radius, out[CONTRAST], out[BLUR]
    p[_SHAPE] = _surroundings(pixels, radius)
    out[STATUS] = _descend(pixels, table, p, radius, reach)
    if out[STATUS] != FITTED:
        return
    _judge(pixels, table, p, 1.0 / reach, offset, slope, out)
    J = np.zeros((*mask.shape, _N + 1))
    Z = np.empty(J.shape)
    A, step = np.empty((_N, _N)), np.zeros(_N)
    chi2 = 0.0
    for _ in range(_WEIGHTED_STEPS):
        _scaled_jacobian(image, mask, left - u, top - v, left, top, reach, table, p, offset, slope, J)
        _along_both_axes(J, weighting, Z)
        chi2 = _normal_matrix(J, Z, A, step)
        if not _solve(A, step.copy(), 1e-9, step):
            out[STATUS] = SINGULAR
            return
        for k in range(_N):
            p[k] += min(max(step[k], -1.0), 1.0)
        p[BLUR] = min(max(p[BLUR], _LEAST_BLUR), p[RADIUS])
        p[RADIUS] = min(max(p[RADIUS], 0.7 * radius), 1.4 * radius)
    if p[U] ** 2 + p[V] ** 2 > (0.5 * radius) ** 2:
        out[STATUS] = WANDERED
        return
    out[PIXELS] = (J[:, :, _SHAPE] != 0.0).sum()
    out[CHI2] = chi2 / max(_expected_chi2(J, weighting * correlation) - _N, 1.0)
    # Residuals may show more noise than the model has (structure), not less: few pixels tell too little for that.
    scale2 = max(1.0, (_PRIOR_PIXELS + out[PIXELS] * out[CHI2]) / (_PRIOR_PIXELS + out[PIXELS]))
    _covariance(Z, A, mask, left - u, top - v, reach, correlation, scale2, out)
    out[:_SHAPE] = p[:_SHAPE]
    out[U] += u
    out[V] += v


@nb.njit(cache=True, fastmath=_FAST)
def _surroundings(pixels, radius):
    """Mean of the pixels outside the disc."""
    total, count = 0.0, 1e-9
    for k in range(len(pixels)):
        if pixels[k, 0] ** 2 + pixels[k, 1] ** 2 > 1.5 * radius**2:
            total += pixels[k, 2]
            count += 1
    return total / count


@nb.njit(cache=True, fastmath=_FAST)
def _scaled_jacobian(image, mask, x0, y0, left, top, reach, table, p, offset, slope, J):  # noqa: PLR0917
    """Derivatives and residual in units of each pixel's noise; 0 where the window does not count."""
    gradient = np.empty(_N)
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            x, y = x0 + j, y0 + i
            if not mask[i, j] or x * x + y * y >= reach * reach:
                J[i, j] = 0.0
                continue
            m, _ground = _model(table, p, x, y, 1.0 / reach, gradient)
            weight = np.exp(-0.5 * (offset - slope * m))
            for k in range(_N):
                J[i, j, k] = gradient[k] * weight
            J[i, j, _N] = (image[top + i, left + j] - m) * weight


@nb.njit(cache=True, fastmath=_FAST)
def _along_both_axes(field, taps, out):
    """Convolve (h, w, n) with the symmetric `taps` along both axes."""
    height, width, n = field.shape
    middle = np.zeros(field.shape)
    for i in range(height):
        for j in range(width):
            for t in range(max(1 - len(taps), -j), min(len(taps), width - j)):
                for k in range(n):
                    middle[i, j, k] += taps[abs(t)] * field[i, j + t, k]
    out[:] = 0.0
    for i in range(height):
        for t in range(max(1 - len(taps), -i), min(len(taps), height - i)):
            for j in range(width):
                for k in range(n):
                    out[i, j, k] += taps[abs(t)] * middle[i + t, j, k]


@nb.njit(cache=True, fastmath=_FAST)
def _normal_matrix(J, Z, A, b):
    """A = J'Z and b = Z'r, of weighted derivatives Z and the residual in the last column; r'Wr."""
    A[:] = 0.0
    b[:] = 0.0
    chi2 = 0.0
    for i in range(J.shape[0]):
        for j in range(J.shape[1]):
            if J[i, j, _SHAPE] == 0.0:
                continue
            chi2 += J[i, j, _N] * Z[i, j, _N]
            for k in range(_N):
                b[k] += Z[i, j, k] * J[i, j, _N]
                for m in range(k + 1):
                    A[k, m] += J[i, j, m] * Z[i, j, k]
    return chi2


@nb.njit(cache=True, fastmath=_FAST)
def _expected_chi2(J, share):
    """Mean of r'Wr for the noise model: over all pairs of pixels that count, weighting times correlation."""
    counts = np.zeros((J.shape[0], J.shape[1], 1))
    for i in range(J.shape[0]):
        for j in range(J.shape[1]):
            counts[i, j, 0] = J[i, j, _SHAPE] != 0.0
    paired = np.empty(counts.shape)
    _along_both_axes(counts, share, paired)
    return (counts * paired).sum()


@nb.njit(cache=True, fastmath=_FAST)
def _covariance(Z, A, mask, x0, y0, reach, correlation, scale2, out):  # noqa: PLR0917
    """What noise of this correlation does to u, v and contrast through the fit's weights, whatever those are."""
    influence = np.empty((3, _N))
    for row, parameter in enumerate((U, V, CONTRAST)):
        unit = np.zeros(_N)
        unit[parameter] = 1.0
        if not _solve(A, unit, 1e-9, influence[row]):
            out[STATUS] = SINGULAR
            return
    H = np.zeros((*mask.shape, 3))
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            if mask[i, j] and (x0 + j) ** 2 + (y0 + i) ** 2 < reach * reach:
                for row in range(3):
                    for k in range(_N):
                        H[i, j, row] += influence[row, k] * Z[i, j, k]
    C = np.empty(H.shape)
    _along_both_axes(H, correlation, C)
    out[CUU] = scale2 * (H[:, :, 0] * C[:, :, 0]).sum()
    out[CUV] = scale2 * (H[:, :, 0] * C[:, :, 1]).sum()
    out[CVV] = scale2 * (H[:, :, 1] * C[:, :, 1]).sum()
    out[CCC] = scale2 * (H[:, :, 2] * C[:, :, 2]).sum()
