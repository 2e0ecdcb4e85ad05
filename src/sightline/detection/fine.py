"""The fine fit of a bead: its window sharpened, then weighted least squares, jointly with beads that touch it."""

import numba as nb
import numpy as np

from sightline.detection.columns import (
    BLUR,
    CCC,
    CHI2,
    CONTRAST,
    CUU,
    CUV,
    CVV,
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
from sightline.detection.shadow import (
    BEAD,
    CUBIC,
    FAST,
    GROUND,
    fill_columns,
    ground_light,
    normal_equations,
    profile,
    solve,
)

_BEYOND = 5.0  # px of background about the rim, and as many blurs as fit [ours]
_SPREAD = 3  # px about a pixel that is not usable, into which the filter carries it
_MOST = 3  # beads of a joint fit
_STEPS = 12
_SETTLED = 0.02  # px: a step as small as that is a tenth of the noise or less, and the next one nothing
_PRIOR_PIXELS = 50.0  # weight of the noise model against the bead's own residuals, in pixels [ours]
_LEAST_BLUR = 0.3  # px; a pixel alone blurs by 0.29
_CUBIC = 0.06  # s.d. of a background's cubic terms at the window's rim, share of its light [twin: hard scenes]
# What is known of a neighbour from its own fit, s.d.: px, px, share of radius, share of opacity, share of blur [ours]
_NEIGHBOUR = np.array([0.7, 0.7, 0.06, 0.15, 0.3])


@nb.njit(parallel=True, cache=True)
def fit_all(image, usable, coarse, others, noise, taps, blur2, after, ball, disc):  # noqa: PLR0917
    """Rows of `coarse` fitted anew. `noise`: offset, slope, gain of sharpening."""
    out = np.empty_like(coarse)
    for i in nb.prange(len(coarse)):
        table = ball if coarse[i, CONTRAST] < 0 else disc
        _fit(image, usable, coarse, i, others, noise, taps, blur2, after, table, out[i])
    return out


@nb.njit(cache=True)
def _group(coarse, i, reach):
    """Rows of the beads to be fitted with bead `i`, itself first: the nearest of those that reach into its window."""
    rows = np.full(_MOST, -1)
    rows[0] = i
    if coarse[i, CONTRAST] > 0:
        return rows[:1]  # the holes of a plate never overlap: another one's place is masked
    gaps = np.full(_MOST, reach - coarse[i, RADIUS] + 2.0)
    for j in range(len(coarse)):
        if j == i or coarse[j, CONTRAST] * coarse[i, CONTRAST] < 0:
            continue
        apart = np.hypot(coarse[j, U] - coarse[i, U], coarse[j, V] - coarse[i, V])
        if apart < coarse[j, RADIUS] - 0.5 * coarse[i, RADIUS]:
            continue  # a wide disc about this bead is structure
        gap = apart - coarse[i, RADIUS] - coarse[j, RADIUS]
        for k in range(1, _MOST):
            if gap < gaps[k]:
                for m in range(_MOST - 1, k, -1):
                    gaps[m], rows[m] = gaps[m - 1], rows[m - 1]
                gaps[k], rows[k] = gap, j
                break
    count = 1
    while count < _MOST and rows[count] >= 0:
        count += 1
    return rows[:count]


@nb.njit(cache=True, fastmath=FAST)
def _mask(usable, others, coarse, rows, left, top, shape):  # noqa: PLR0917
    """Which pixels of the window count: usable and so their neighbours, on no disc but those of `rows`."""
    h, w = shape
    height, width = usable.shape
    mask = np.ones((h, w), np.bool_)
    for i in range(-_SPREAD, h + _SPREAD):
        for j in range(-_SPREAD, w + _SPREAD):
            y, x = top + i, left + j
            if 0 <= y < height and 0 <= x < width and usable[y, x]:
                continue
            for a in range(max(i - _SPREAD, 0), min(i + _SPREAD + 1, h)):
                for b in range(max(j - _SPREAD, 0), min(j + _SPREAD + 1, w)):
                    mask[a, b] = False
    strength = abs(coarse[rows[0], CONTRAST])
    for k in range(len(others)):
        x, y, reach = others[k, U] - left, others[k, V] - top, others[k, RADIUS] + 2.5
        if x + reach < 0 or y + reach < 0 or x - reach > w or y - reach > h or abs(others[k, 3]) < 0.5 * strength:
            continue
        one = coarse[rows[0]]
        mine = np.hypot(others[k, U] - one[U], others[k, V] - one[V]) < others[k, RADIUS] - 0.5 * one[RADIUS]
        for row in rows:
            apart = np.hypot(others[k, U] - coarse[row, U], others[k, V] - coarse[row, V])
            mine |= apart < 0.8 * max(coarse[row, RADIUS], others[k, RADIUS])
        if not mine:
            for i in range(max(0, int(y - reach)), min(h, int(y + reach) + 2)):
                for j in range(max(0, int(x - reach)), min(w, int(x + reach) + 2)):
                    if (i - y) ** 2 + (j - x) ** 2 < reach * reach:
                        mask[i, j] = False
    return mask


@nb.njit(cache=True, fastmath=True)
def _sharpened(image, left, top, shape, taps, zero):  # noqa: PLR0917
    """The window's light, exp(image - zero), plain and sharpened; the image's border repeats."""
    h, w = shape
    t = len(taps) - 1
    height, width = image.shape
    light = np.empty((h + 2 * t, w + 2 * t), np.float32)
    for i in range(h + 2 * t):
        y = min(max(top + i - t, 0), height - 1)
        for j in range(w + 2 * t):
            light[i, j] = image[y, min(max(left + j - t, 0), width - 1)] - zero
    for i in range(h + 2 * t):
        for j in range(w + 2 * t):
            light[i, j] = np.exp(max(light[i, j], np.float32(-8.0)))
    return light[t : h + t, t : w + t], _along_both_axes(light, taps)


@nb.njit(cache=True, fastmath=FAST)
def _fit(image, usable, coarse, row, others, noise, taps, blur2, after, table, out):  # noqa: PLR0917
    out[:] = coarse[row]
    radius = coarse[row, RADIUS]
    reach = radius + _BEYOND
    rows = _group(coarse, row, reach)
    count = len(rows)
    size = BEAD * count + GROUND
    u, v = int(coarse[row, U] + 0.5), int(coarse[row, V] + 0.5)
    half = int(reach) + 1
    left, top, shape = u - half, v - half, (2 * half + 1, 2 * half + 1)
    mask = _mask(usable, others, coarse, rows, left, top, shape)
    zero, pixels = _level(image, mask, left, top, coarse[row, U] - left, coarse[row, V] - top, radius, reach)
    if pixels < 3 * size:
        out[STATUS] = TOO_FEW_PIXELS
        return
    light, sharp = _sharpened(image, left, top, shape, taps, np.float32(zero))
    at, where = _gather(mask, sharp, coarse[row, U] - left, coarse[row, V] - top, reach, pixels)
    beads = _start(coarse, rows, blur2)
    first = beads.copy()
    ground = np.zeros(GROUND)
    ground[0] = 1.0
    columns = np.empty((size + 1, pixels), np.float32)
    root = np.ones(pixels, np.float32)
    A, L, b, step = np.empty((size, size)), np.empty((size, size)), np.empty(size), np.zeros(size)
    scale = 1.0 / reach
    lift = np.exp(0.5 * (noise[0] - noise[1] * zero)) * np.sqrt(noise[2])  # relative deviation at `zero`, sharpened
    out[STATUS] = WANDERED
    chi2 = 0.0
    for turn in range(_STEPS):
        if turn < 3:
            _weights(table, at, beads, ground, scale, lift, noise[1], root)
        fill_columns(table, at, beads, ground, scale, root, columns)
        chi2 = normal_equations(columns, A, b)
        _rely_on_neighbours(beads, first, A, b)
        _rely_on_smoothness(ground, A, b)
        for k in range(size):
            A[k, k] *= 1.0 + 1e-5
        if not solve(A, b, L, step):
            out[STATUS] = SINGULAR
            return
        moved = _move(beads, ground, step)
        if np.hypot(beads[0, 0], beads[0, 1]) > 0.5 * radius + 1 or not 0.5 < beads[0, 2] / radius < 1.9:
            return
        if moved < _SETTLED and turn > 1:
            out[STATUS] = FITTED
            break
    if out[STATUS] != FITTED:
        return
    out[PIXELS] = pixels
    out[CHI2] = chi2 / max(out[PIXELS] - size, 1.0)
    scale2 = (_PRIOR_PIXELS + pixels * out[CHI2]) / (_PRIOR_PIXELS + pixels)
    _covariance(columns, where, A, L, shape, after, scale2, out)
    _judge(table, at, where, light, beads, ground, scale, blur2, noise, zero, out)
    out[CCC] /= max(1.0 - beads[0, 3], 0.02) ** 2
    out[U], out[V], out[RADIUS] = coarse[row, U] + beads[0, 0], coarse[row, V] + beads[0, 1], beads[0, 2]
    out[CONTRAST] = np.log(max(1.0 - beads[0, 3], 1e-3))
    out[BLUR] = np.sqrt(beads[0, 4] ** 2 - blur2)


@nb.njit(cache=True, fastmath=FAST)
def _start(coarse, rows, blur2):
    """The beads of a joint fit, from the first one's coarse centre."""
    beads = np.empty((len(rows), BEAD))
    for k in range(len(rows)):
        one = coarse[rows[k]]
        beads[k, 0], beads[k, 1], beads[k, 2] = one[U] - coarse[rows[0], U], one[V] - coarse[rows[0], V], one[RADIUS]
        beads[k, 3] = 1.0 - np.exp(one[CONTRAST])
        beads[k, 4] = np.sqrt(max(one[BLUR] ** 2 + blur2, 0.4**2))
    return beads


@nb.njit(cache=True, fastmath=FAST)
def _level(image, mask, left, top, u, v, radius, reach):  # noqa: PLR0917
    """Mean of the window's log light outside the disc, and the number of pixels that count."""
    total, outside, pixels = 0.0, 0, 0
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            r2 = (j - u) ** 2 + (i - v) ** 2
            if mask[i, j] and r2 < reach * reach:
                pixels += 1
                if r2 > (radius + 1.5) ** 2:
                    total += image[top + i, left + j]
                    outside += 1
    return total / max(outside, 1), pixels


@nb.njit(cache=True, fastmath=FAST)
def _gather(mask, sharp, u, v, reach, pixels):  # noqa: PLR0917
    """x, y from the bead's coarse centre and value of each pixel that counts, and its place in the window."""
    at, where = np.empty((3, pixels), np.float32), np.empty((2, pixels), np.int32)
    n = 0
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            x, y = j - u, i - v
            if mask[i, j] and x * x + y * y < reach * reach:
                at[0, n], at[1, n], at[2, n] = x, y, sharp[i, j]
                where[0, n], where[1, n] = i, j
                n += 1
    return at, where


@nb.njit(cache=True, fastmath=FAST)
def _light(table, x, y, beads, ground, scale, widen):  # noqa: PLR0917
    """Model at one pixel, and its background; `widen` px² is added to the beads' blur²."""
    a, b = x * scale, y * scale
    bright = ground_light(ground, a, b)
    most, left = beads[0, 3], 1.0
    for k in range(1, len(beads)):
        if abs(beads[k, 3]) > abs(most):
            most = beads[k, 3]
    for k in range(len(beads)):
        r = np.sqrt((x - beads[k, 0]) ** 2 + (y - beads[k, 1]) ** 2)
        d, _r, _radius, _blur = profile(table, r, beads[k, 2], np.sqrt(beads[k, 4] ** 2 + widen))
        left *= 1.0 - beads[k, 3] * d / most
    return bright * (1.0 - most * (1.0 - left)), bright


@nb.njit(cache=True, fastmath=FAST)
def _weights(table, at, beads, ground, scale, lift, slope, root):  # noqa: PLR0917
    """One over the deviation that the noise has where the model has this light."""
    for p in range(at.shape[1]):
        light, _ground = _light(table, at[0, p], at[1, p], beads, ground, scale, 0.0)
        light = max(light, 0.02)
        root[p] = np.exp((0.5 * slope - 1.0) * np.log(light)) / lift


@nb.njit(cache=True)
def _rely_on_neighbours(beads, first, A, b):
    for k in range(1, len(beads)):
        for m in range(BEAD):
            sd = _NEIGHBOUR[m] * (abs(first[k, m]) if m > 1 else 1.0)
            i = BEAD * k + m
            A[i, i] += 1.0 / sd**2
            b[i] += (first[k, m] - beads[k, m]) / sd**2


@nb.njit(cache=True)
def _rely_on_smoothness(ground, A, b):
    """Cubic terms are small: without them bone edges shift the centre, free ones cost a third of the accuracy."""
    for m in range(GROUND - CUBIC, GROUND):
        i = len(b) - GROUND + m
        A[i, i] += 1.0 / _CUBIC**2
        b[i] -= ground[m] / _CUBIC**2


@nb.njit(cache=True)
def _move(beads, ground, step):
    """Take a step, shortened where it is wild; the largest move of the first bead's centre and radius, px."""
    for k in range(len(beads)):
        at = BEAD * k
        radius, blur = beads[k, 2], beads[k, 4]
        for m in range(2):
            beads[k, m] += min(max(step[at + m], -1.0), 1.0)
        beads[k, 2] += min(max(step[at + 2], -0.15 * radius), 0.15 * radius)
        beads[k, 3] = min(max(beads[k, 3] + min(max(step[at + 3], -0.3), 0.3), -20.0), 0.999)
        beads[k, 4] = min(max(blur + step[at + 4], _LEAST_BLUR, 0.6 * blur), 1.6 * blur, beads[k, 2])
    for m in range(GROUND):
        ground[m] += step[BEAD * len(beads) + m]
    return max(abs(step[0]), abs(step[1]), abs(step[2]))


@nb.njit(cache=True, fastmath=FAST)
def _covariance(columns, where, A, L, shape, after, scale2, out):  # noqa: PLR0917
    """What noise of the correlation `after` does to u, v and opacity through the fit."""
    size = len(A)
    unit, influence = np.zeros(size), np.empty((3, size))
    for row, parameter in enumerate((0, 1, 3)):
        unit[:] = 0.0
        unit[parameter] = 1.0
        if not solve(A, unit, L, influence[row]):
            out[STATUS] = SINGULAR
            return
    reach = len(after) - 1
    h, w = shape
    field = np.zeros((3, h + 2 * reach, w + 2 * reach), np.float32)
    for row in range(3):
        for p in range(columns.shape[1]):
            s = np.float32(0.0)
            for k in range(size):
                s += influence[row, k] * columns[k, p]
            field[row, where[0, p] + reach, where[1, p] + reach] = s
    spread = np.empty((3, h, w), np.float32)
    for row in range(3):
        spread[row] = _along_both_axes(field[row], after)
    inner = field[:, reach : h + reach, reach : w + reach]
    out[CUU] = scale2 * (inner[0] * spread[0]).sum()
    out[CUV] = scale2 * (inner[0] * spread[1]).sum()
    out[CVV] = scale2 * (inner[1] * spread[1]).sum()
    out[CCC] = scale2 * (inner[2] * spread[2]).sum()


@nb.njit(cache=True, fastmath=FAST)
def _judge(table, at, where, light, beads, ground, scale, blur2, noise, zero, out):  # noqa: PLR0917
    """How well the bead explains its window as it was before sharpening: residual, weakest sector, how hollow."""
    seen, meant = np.zeros(8), np.zeros(8)
    residuals, hollow, middle, expected = 0.0, 0.0, 1e-9, 0.0
    pixels = at.shape[1]
    for p in range(0, pixels):
        x, y = at[0, p], at[1, p]
        m, bright = _light(table, x, y, beads, ground, scale, -blur2)
        m = max(m, 0.02)
        residual = (light[where[0, p], where[1, p]] - m) / m
        residuals += residual * residual
        expected += np.exp(noise[0] - noise[1] * (zero + np.log(m)))
        bead = m / bright - 1.0
        sector = int((np.arctan2(y - beads[0, 1], x - beads[0, 0]) / (2 * np.pi) + 1.0) * 8) % 8
        if (x - beads[0, 0]) ** 2 + (y - beads[0, 1]) ** 2 < (beads[0, 2] + 1) ** 2:
            seen[sector] += (residual * m / bright + bead) * bead
            meant[sector] += bead * bead
        if (x - beads[0, 0]) ** 2 + (y - beads[0, 1]) ** 2 < (0.4 * beads[0, 2]) ** 2:
            hollow += residual
            middle += 1
    out[MISFIT] = np.sqrt(residuals / pixels)
    out[NOISE] = expected / pixels
    out[WEAKEST] = 1.0
    for k in range(8):
        if meant[k] > meant.sum() / 32:  # a sector that a neighbour covers says nothing
            out[WEAKEST] = min(out[WEAKEST], seen[k] / meant[k])
    out[HOLLOW] = hollow / middle


@nb.njit(cache=True, fastmath=True)
def _along_both_axes(field, taps):
    """`field` convolved along both axes with the symmetric `taps`, without its margin of as many pixels."""
    t = len(taps) - 1
    h, w = field.shape[0] - 2 * t, field.shape[1] - 2 * t
    middle = taps[0] * field[t : t + h]
    for k in range(1, t + 1):
        middle += taps[k] * (field[t - k : t - k + h] + field[t + k : t + k + h])
    out = taps[0] * middle[:, t : t + w]
    for k in range(1, t + 1):
        out += taps[k] * (middle[:, t - k : t - k + w] + middle[:, t + k : t + k + w])
    return out
