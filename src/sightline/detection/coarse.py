"""The coarse fit of a spot: least squares in log light, all pixels alike, to tell beads from what is none."""

import numba as nb
import numpy as np

from sightline.detection.columns import (
    BLUR,
    CONTRAST,
    FITTED,
    HOLLOW,
    MISFIT,
    NOISE,
    PIXELS,
    RADIUS,
    SINGULAR,
    STATUS,
    TOO_FEW_PIXELS,
    WANDERED,
    WEAKEST,
    U,
    V,
)
from sightline.detection.shadow import BEAD, FAST, profile, solve

_N = 11  # parameters: u, v, radius, contrast, blur, then the background's 1, x, y, x², xy, y² in window units
_LEAST_BLUR = 0.35  # px; a pixel alone blurs as much
_STEPS = 25
_ENOUGH = 250  # pixels; of a wider window every second, third ... along the rows [ours]


@nb.njit(parallel=True, cache=True, fastmath=FAST)
def fit_all(image, usable, spots, others, offset, slope, ball, disc):  # noqa: PLR0917
    """Rows of u, v, radius, response fitted: (M, NOISE + 1)."""
    out = np.zeros((len(spots), NOISE + 1))
    for i in nb.prange(len(spots)):
        _fit_coarse(image, usable, others, spots[i], ball if spots[i, 3] < 0 else disc, offset, slope, out[i])
    return out


@nb.njit(cache=True, fastmath=FAST)
def _model(table, p, x, y, scale, gradient):  # noqa: PLR0917
    """Log intensity at (x, y) and its background; the derivatives by the parameters go into `gradient`."""
    dx, dy = x - p[U], y - p[V]
    r = np.sqrt(dx * dx + dy * dy) + 1e-9
    d, d_r, d_radius, d_blur = profile(table, r, p[RADIUS], p[BLUR])
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


@nb.njit(cache=True, fastmath=FAST)
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


@nb.njit(cache=True, fastmath=FAST)
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
    p[BEAD] = _surroundings(pixels, radius)
    out[STATUS] = _descend(pixels, table, p, radius, reach)
    out[PIXELS] = len(pixels)
    if out[STATUS] == FITTED:
        out[:BEAD] = p[:BEAD]
        out[U] += u
        out[V] += v
        _judge(pixels, table, p, 1.0 / reach, offset, slope, out)


@nb.njit(cache=True, fastmath=FAST)
def _descend(pixels, table, p, radius, reach):
    """Levenberg-Marquardt on `p`; the status."""
    gradient, step, trial = np.empty(_N), np.zeros(_N), p.copy()
    A, b = np.empty((_N, _N)), np.empty(_N)
    A_best, b_best, L = np.empty((_N, _N)), np.empty(_N), np.empty((_N, _N))
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
        if damping > 1e4 or not _damped(A_best, b_best, damping + 1e-6, A, L, step):
            return SINGULAR
        for k in range(_N):
            trial[k] = p[k] + step[k]
        trial[RADIUS] = min(max(trial[RADIUS], 0.6 * p[RADIUS]), 1.6 * p[RADIUS])
        trial[BLUR] = min(max(trial[BLUR], _LEAST_BLUR, 0.5 * p[BLUR]), 2 * p[BLUR], trial[RADIUS])
        trial[CONTRAST] = min(max(trial[CONTRAST], -6.0), 4.0)
        if trial[U] ** 2 + trial[V] ** 2 > (0.6 * radius + 1) ** 2 or not 0.45 * radius < trial[RADIUS] < 1.9 * radius:
            return WANDERED
    return FITTED


@nb.njit(cache=True, fastmath=FAST)
def _surroundings(pixels, radius):
    """Mean of the pixels outside the disc."""
    total, count = 0.0, 1e-9
    for k in range(len(pixels)):
        if pixels[k, 0] ** 2 + pixels[k, 1] ** 2 > 1.5 * radius**2:
            total += pixels[k, 2]
            count += 1
    return total / count


@nb.njit(cache=True, fastmath=FAST)
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


@nb.njit(cache=True, fastmath=FAST)
def _damped(A, b, damping, damped, L, x):  # noqa: PLR0917
    """Solve (A + damping diag A) x = b; False if A is not positive."""
    damped[:] = A
    for k in range(len(b)):
        damped[k, k] *= 1.0 + damping
    return solve(damped, b, L, x)
