"""Fit a bead by weighted least squares in its window, jointly with neighbours that overlap the window."""

import numpy as np

from sightline.detection.beads.columns import (
    AXIAL,
    BLUR,
    CCC,
    CHI2,
    CONTRAST,
    CUU,
    CUV,
    CVV,
    DIAGONAL,
    EXCESS,
    FITTED,
    LARGE,
    RADIUS,
    SINGULAR,
    STATUS,
    TOO_FEW_PIXELS,
    WANDERED,
    WEAKEST,
    U,
    V,
)
from sightline.detection.beads.noise import LAGS
from sightline.detection.beads.shadow import (
    BACKGROUND,
    BACKGROUND_TERMS,
    BEAD_AXIAL,
    BEAD_BLUR,
    BEAD_DIAGONAL,
    BEAD_LARGE,
    BEAD_RADIUS,
    BEAD_TERMS,
    BEAD_X,
    BEAD_Y,
    CUBIC_TERMS,
    LIGHT,
    RESIDUAL,
    SCATTER_TERMS,
    STOPPED_BY_BALL,
    STOPPED_BY_HOLE,
    fill_light,
    fill_slopes,
    normal_equations,
    solve,
    substitute,
)
from sightline.detection.beads.window import (
    BEYOND,
    MARGIN,
    VECTOR,
    along_both_axes,
    correlated_products,
    gather_pixels,
    hide_metal,
    log_level,
    mark_near_unusable,
    pixel_states,
    visible_rim,
    window_light,
)
from sightline.kernels import FAST, exact, fast, kernel, part_of_caller, squared

_LIGHT_STEPS = 32  # entries of the noise table per unit of light
MAX_JOINT = 3  # beads of a joint fit
_MAX_ITERATIONS = 12
# Iterations before weights and pixels are frozen and steps are halved; otherwise the fit oscillates [ours].
_ADAPTIVE_ITERATIONS = 4
# Steps, in px and in shares of the light, at which a fit has converged: the last one, and the sum of those to come, if
# they shrink as the last one did. They are at most a tenth of the noise [ours].
_CONVERGED, _REMAINS = 0.02, 0.007
PRIOR_PIXELS = 50.0  # weight of the noise model against the bead's own residuals, in pixels [ours]
MIN_BLUR_PX = 0.3  # a pixel alone blurs by 0.29
_CUBIC_SD = 0.06  # s.d. of the background's cubic terms at the window's rim, share of its light [twin: hard scenes]
# Prior of the scatter's relative slope, as a share of the background's: 0 for even scatter, 1 where scatter follows the
# background. With STOPPED_BY_BALL, the light behind a ball has 0.03-0.4 of the background's slope instead of 0-0.5
# [twin: kernels of 8 mm to even]. _UNCOUPLED_SD is the part that does not depend on the background.
_COUPLING, _COUPLING_SD, _UNCOUPLED_SD = 0.35, 0.5, 0.01
# Background slope per window above which it is the edge of a bone, which scatter does not follow [twin], or is not
# known, because the background is clipped.
_MAX_SLOPE = 0.1
_MIN_CUBIC = 0.005  # smallest cubic terms that the covariance allows for [ours]
# S.d. of the background's level, slopes and quadratic terms; they matter where the background is clipped [ours].
_BACKGROUND_SD = np.array([1.0, 0.5, 0.5, 0.3, 0.3, 0.3])
CLIPPING_MARGIN_SD = 2.0  # of the noise, below the brightest value [ours]
SUSPICIOUS_EXCESS = 0.05  # residual beyond noise over contrast: isolated beads have 0.00-0.04 [twin]
_MIN_RIM_SHARE = 0.7  # share of the rim that metal must leave: the straight sides of a wire look like short arcs [ours]
_NOISE_MARGIN = 1.3  # noise alone may reach this many times the expected sum of squares [ours]
MAX_ELLIPTICITY = 0.12  # beads in images have up to 0.09, pieces of wire more [twin]
# Covariance beyond the linear approximation, in units of the centre's variance over the squared blur [twin].
_RIM_NONLINEARITY = 3.0
_LARGE_WINDOW = 320  # px [ours]
MAX_RIM_LOST = 0.15  # share of the rim that sharpening may cost; above it, the window is not sharpened [ours]
# Prior s.d. of x, y, radius, blur and ellipticity about their initial values, for the bead and its neighbours: px, px,
# share of the radius, share of the blur [ours], of a shadow's ellipticity: distortion and oblique rays give 0.00-0.08
# [twin].
PRIOR_SD = np.array([[2.0, 2.0, 0.2, 0.5, 0.05, 0.05], [0.7, 0.7, 0.06, 0.3, 0.05, 0.05]])


@exact
def _copy(values, out):
    for k in range(len(out)):  # assigning to out[:] takes seconds to compile
        out[k] = values[k]


@exact
def joint_rows(spots, i, reach, prior_sd):
    """Return the rows of bead `i` and of the nearest beads that reach into its window: MAX_JOINT at most.

    A wide disc around bead `i` is anatomy, unless `prior_sd` says that its shape is known: then it is a ball.
    """
    rows, gaps = np.empty(MAX_JOINT, np.int64), np.empty(MAX_JOINT)
    rows[:], rows[0] = -1, i
    if spots[i, CONTRAST] > 0:
        return rows[:1]  # holes of a plate never overlap: neighbours are masked
    gaps[:] = reach - spots[i, RADIUS] + 2.0
    for j in range(len(spots)):
        if j == i or spots[j, CONTRAST] * spots[i, CONTRAST] < 0:
            continue
        du, dv, near = spots[j, U] - spots[i, U], spots[j, V] - spots[i, V], reach + spots[j, RADIUS] + 2.0
        if not (abs(du) < near and abs(dv) < near):
            continue  # most spots are far away
        apart = np.hypot(du, dv)
        known = prior_sd[1, j, BEAD_RADIUS] < PRIOR_SD[1, BEAD_RADIUS]
        if not known and apart < spots[j, RADIUS] - 0.5 * spots[i, RADIUS]:
            continue
        gap = apart - spots[i, RADIUS] - spots[j, RADIUS]
        for k in range(1, MAX_JOINT):
            if gap < gaps[k]:
                for m in range(MAX_JOINT - 1, k, -1):
                    gaps[m], rows[m] = gaps[m - 1], rows[m - 1]
                gaps[k], rows[k] = gap, j
                break
    count = 1
    while count < MAX_JOINT and rows[count] >= 0:
        count += 1
    return rows[:count]


@part_of_caller
def _solve(spots, rows, noise, unit_sds, sharpening, plain, prior_sd, tables, light, state, window, out):  # noqa: PLR0917
    """Fit the beads `rows` jointly to the visible pixels and write the first bead's result into `out`."""
    left, top, reach, zero = window
    row, radius = rows[0], spots[rows[0], RADIUS]
    table, stopped = (tables[0], STOPPED_BY_BALL) if spots[row, CONTRAST] < 0 else (tables[1], STOPPED_BY_HOLE)
    size = BEAD_TERMS * len(rows) + SCATTER_TERMS + BACKGROUND_TERMS
    x0, y0 = spots[row, U] - left, spots[row, V] - top
    filtered = mark_near_unusable(state, x0, y0, radius) < MAX_RIM_LOST
    taps, gain, blur2, together2, correlation, by_lag = sharpening if filtered else plain
    at, where, counting = gather_pixels(
        state, filtered, along_both_axes(light, taps) if filtered else light, x0, y0, reach
    )
    beads, scatter, background = initial_values(spots, rows, blur2)
    initial = beads.copy()
    columns, inverse_sd = np.empty((size + 3, at.shape[1]), np.float32), np.empty(at.shape[1], np.float32)
    behind, effect = np.empty((4, at.shape[1]), np.float32), np.empty((len(rows), at.shape[1]), np.float32)
    A, L, b, step = np.empty((size + 2, size + 2)), np.empty((size, size)), np.empty(size), np.zeros(size)
    prior, wanted = np.zeros(size), np.array([BEAD_X, BEAD_Y, BEAD_TERMS * len(rows)])
    optics = np.float32(1.0 / reach), stopped, np.float32(together2)
    inverse_sds = unit_sds / np.float32(np.exp(0.5 * (noise[0] - noise[1] * zero)) * np.sqrt(gain))
    brightest = np.exp(noise[2] - zero - CLIPPING_MARGIN_SD * np.exp(0.5 * (noise[0] - noise[1] * noise[2])))
    out[STATUS], chi2, pixels, coupling, moved = TOO_FEW_PIXELS, 0.0, 0, 0.0, np.inf
    for iteration in range(_MAX_ITERATIONS + 1):
        fill_light(table, at, beads, scatter, background, optics, behind, effect, columns)
        if iteration == _MAX_ITERATIONS or out[STATUS] == FITTED:  # the light of the result, before sharpening
            break
        if iteration < _ADAPTIVE_ITERATIONS:
            pixels = weigh(columns[LIGHT], counting, np.float32(brightest), inverse_sds, inverse_sd)
        if pixels < 2 * size:
            return
        fill_slopes(at, optics[0], inverse_sd, behind, effect, columns)
        chi2 = normal_equations(columns, A, b)
        coupling = add_priors(beads, initial, rows, prior_sd, scatter, background, prior, A, b)
        if not solve(A, b, L, step):
            out[STATUS] = SINGULAR
            return
        before = moved
        moved = _take_step(beads, scatter, background, step, 1.0 if iteration < _ADAPTIVE_ITERATIONS else 0.5)
        out[STATUS] = WANDERED
        if (
            squared(beads[0, BEAD_X]) + squared(beads[0, BEAD_Y]) > squared(0.5 * radius + 1)
            or not 0.5 < beads[0, BEAD_RADIUS] / radius < 1.9
        ):
            return
        if iteration == 0 or not (moved < _CONVERGED or moved * moved < _REMAINS * (before - moved)):
            continue
        if squared(beads[0, BEAD_AXIAL]) + squared(beads[0, BEAD_DIAGONAL]) > squared(MAX_ELLIPTICITY):
            return
        out[STATUS] = FITTED
        freedom = max(pixels - _effective_parameters(columns, where, L, by_lag), 1.0)
        out[CHI2], scale2 = chi2 / freedom, (PRIOR_PIXELS + chi2) / (PRIOR_PIXELS + freedom)
        out[BLUR] = np.sqrt(max(squared(beads[0, BEAD_BLUR]) - blur2, 0.0))
        _covariance(wanted, columns, where, L, len(state), correlation, scale2, prior, coupling, background, out)
        inside = max((1.0 - stopped) * background[0] + scatter[0], 0.02 * background[0])
        out[CCC] /= squared(inside)
        out[U], out[V], out[RADIUS] = (
            spots[row, U] + beads[0, BEAD_X],
            spots[row, V] + beads[0, BEAD_Y],
            beads[0, BEAD_RADIUS],
        )
        out[AXIAL], out[DIAGONAL] = beads[0, BEAD_AXIAL], beads[0, BEAD_DIAGONAL]
        out[CONTRAST] = np.log(inside / max(background[0], 1e-3))
        optics = optics[0], stopped, unsharpen(beads, at, where, light, blur2, together2)
    if out[STATUS] == FITTED:
        assess(at, beads, gain, inverse_sd, pixels, behind, columns, out)


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def fit_part(part, parts, image, usable, spots, which, noise, sharpening, plain, prior_sd, tables, out):  # noqa: PLR0917
    """Fit rows `which[part::parts]` of `spots` and write row `which[i]` into row i of `out`.

    `noise`: offset, slope, and the log intensity at which pixels are clipped. `sharpening`: taps, gain, change of the
    squared blur, remaining squared blur, noise correlation after sharpening by lag along an axis, and by distance.
    `plain`: the same without sharpening.
    Where a large residual remains, metal around the bead is searched for and hidden, and the fit is repeated.
    """
    result, unit_sds = np.empty(spots.shape[1]), inverse_sd_table(noise[1])
    for i in range(part, len(which), parts):
        row = which[i]
        reach = spots[row, RADIUS] + BEYOND
        rows = joint_rows(spots, row, reach, prior_sd)
        half = int(reach) + 1
        left, top = int(spots[row, U] + 0.5) - half, int(spots[row, V] + 0.5) - half
        zero = log_level(image, usable, spots[row], reach)
        light = window_light(image, left, top, half, zero)
        state = pixel_states(image, usable, spots, rows, left, top, 2 * half + 1, noise[2])
        window = left, top, reach, zero
        for again in range(2):
            _copy(spots[row], result)
            _solve(spots, rows, noise, unit_sds, sharpening, plain, prior_sd, tables, light, state, window, result)
            better = result[STATUS] == FITTED and (out[i, STATUS] != FITTED or result[EXCESS] < out[i, EXCESS])
            if better or not again:
                _copy(result, out[i])
            if again or (result[STATUS] == FITTED and result[EXCESS] <= SUSPICIOUS_EXCESS) or spots[row, CONTRAST] > 0:
                break
            metal = hide_metal(state, spots, rows, left, top, light)
            if not metal or visible_rim(state, spots, rows, left, top) <= _MIN_RIM_SHARE:
                break


@exact
def initial_values(spots, rows, blur2):
    """Return initial beads (K, BEAD_LARGE + 1), relative to the first one's place, scatter and background."""
    one = spots[rows[0]]
    beads = np.zeros((len(rows), BEAD_LARGE + 1))
    for k in range(len(rows)):
        bead = spots[rows[k]]
        beads[k, BEAD_X], beads[k, BEAD_Y], beads[k, BEAD_RADIUS] = bead[U] - one[U], bead[V] - one[V], bead[RADIUS]
        beads[k, BEAD_BLUR] = np.sqrt(max(bead[BLUR] ** 2 + blur2, 0.4**2))
        beads[k, BEAD_AXIAL], beads[k, BEAD_DIAGONAL], beads[k, BEAD_LARGE] = bead[AXIAL], bead[DIAGONAL], bead[LARGE]
    scatter, background = np.zeros(SCATTER_TERMS), np.zeros(BACKGROUND_TERMS)
    background[0] = 1.0
    scatter[0] = np.exp(one[CONTRAST]) - (1.0 - STOPPED_BY_BALL if one[CONTRAST] < 0 else 1.0)
    return beads, scatter, background


@exact
def inverse_sd_table(slope):
    """Return one over the noise's s.d. at light 0 to 2, in units of that at 1.

    _LIGHT_STEPS entries per unit: fine enough for weights.
    """
    inverse_sds = np.empty(2 * _LIGHT_STEPS, np.float32)
    for k in range(len(inverse_sds)):
        inverse_sds[k] = ((k + 0.5) / _LIGHT_STEPS) ** (0.5 * slope - 1.0)
    return inverse_sds


@part_of_caller
def weigh(light, counting, brightest, inverse_sds, inverse_sd):
    """Fill `inverse_sd` with one over the noise's s.d. at the model's light; return how many pixels count.

    Zero, for pixels that do not count: those from `counting` on, and those that the model makes brighter than
    `brightest`, which may be clipped. The model decides, not the value seen: selecting by the value would keep the
    pixels with negative noise.
    """
    count, zero, steps, last = np.int32(0), np.float32(0.0), np.float32(_LIGHT_STEPS), np.float32(2 * _LIGHT_STEPS - 1)
    for p in range(len(inverse_sd)):
        at = np.uint32(np.int32(min(max(light[p] * steps, zero), last)))
        inverse_sd[p] = inverse_sds[at] if light[p] < brightest else zero
    for p in range(counting, len(inverse_sd)):
        inverse_sd[p] = zero
    for p in range(len(inverse_sd)):
        count += np.int32(1) if inverse_sd[p] > zero else np.int32(0)
    return count


@exact
def add_priors(beads, initial, rows, prior_sd, scatter, background, prior, A, b):  # noqa: PLR0917
    """Add the priors to the normal equations `A`, `b` and fill `prior` with their precisions (1 / s.d.²).

    Cubic terms are near zero; a bead's centre, shape and blur are near their initial values; scatter
    slopes follow the background's. Returns the coupling: expected scatter slope over background slope.
    """
    prior[:] = 0.0
    for k in range(len(beads)):
        for m in range(BEAD_TERMS):
            sd = prior_sd[min(k, 1), rows[k], m] * (abs(initial[k, m]) if BEAD_RADIUS <= m < BEAD_AXIAL else 1.0)
            prior[BEAD_TERMS * k + m] = 1.0 / sd**2
            b[BEAD_TERMS * k + m] += (initial[k, m] - beads[k, m]) / sd**2
    at, to, slope = BEAD_TERMS * len(beads) + 1, len(b) - BACKGROUND_TERMS + 1, np.hypot(background[1], background[2])
    share = scatter[0] * min(1.0, _MAX_SLOPE / max(slope, 1e-9))
    coupling, sd2 = _COUPLING * share, (_COUPLING_SD * share * slope) ** 2 + (_UNCOUPLED_SD * scatter[0]) ** 2 + 1e-6
    for m in range(SCATTER_TERMS - 1):
        off = (coupling * background[1 + m] - scatter[1 + m]) / sd2
        prior[at + m] = 1.0 / sd2
        b[at + m] += off
        b[to + m] -= coupling * off
        A[to + m, at + m] -= coupling / sd2
        A[to + m, to + m] += coupling**2 / sd2
    for m in range(BACKGROUND_TERMS - CUBIC_TERMS):
        prior[len(b) - BACKGROUND_TERMS + m] = 1.0 / _BACKGROUND_SD[m] ** 2
        b[len(b) - BACKGROUND_TERMS + m] -= (background[m] - (1.0 if m == 0 else 0.0)) / _BACKGROUND_SD[m] ** 2
    for m in range(BACKGROUND_TERMS - CUBIC_TERMS, BACKGROUND_TERMS):
        # Without cubic terms, bone edges shift the centre; unconstrained, they cost a third of the accuracy.
        prior[len(b) - BACKGROUND_TERMS + m] = 1.0 / _CUBIC_SD**2
        b[len(b) - BACKGROUND_TERMS + m] -= background[m] / _CUBIC_SD**2
    for k in range(len(b)):
        A[k, k] = (A[k, k] + prior[k]) * (1.0 + 1e-5)
    return coupling


@exact
def _take_step(beads, scatter, background, step, share):
    """Apply `share` of a step, each parameter's change limited.

    Returns the largest step of the first bead's centre and radius (px) and of the scatter level (share of the light).
    """
    for k in range(len(step)):
        step[k] *= share
    for k in range(len(beads)):
        at = BEAD_TERMS * k
        radius, blur = beads[k, BEAD_RADIUS], beads[k, BEAD_BLUR]
        for m in range(BEAD_RADIUS):
            beads[k, m] += min(max(step[at + m], -1.0), 1.0)
        beads[k, BEAD_RADIUS] += min(max(step[at + BEAD_RADIUS], -0.15 * radius), 0.15 * radius)
        beads[k, BEAD_BLUR] = min(
            max(blur + step[at + BEAD_BLUR], MIN_BLUR_PX, 0.6 * blur), 1.6 * blur, beads[k, BEAD_RADIUS]
        )
        for m in range(BEAD_AXIAL, BEAD_TERMS):
            beads[k, m] = min(max(beads[k, m] + step[at + m], -0.3), 0.3)
    at = BEAD_TERMS * len(beads)
    for m in range(SCATTER_TERMS):
        scatter[m] += min(max(step[at + m], -0.5), 0.5)
    for m in range(BACKGROUND_TERMS):
        background[m] += step[at + SCATTER_TERMS + m]
    return max(abs(step[BEAD_X]), abs(step[BEAD_Y]), abs(step[BEAD_RADIUS]), abs(step[at]))


@fast
def _effective_parameters(columns, where, L, by_lag):
    """Return the effective number of parameters: tr(H C) with the projection H = J A^-1 J' and the noise correlation C.

    The fit lowers the expected sum of squared residuals by so much. For white noise it is the number of parameters.
    `by_lag` (LAGS + 1,): the correlations of all neighbours at about this distance. H is nearly the same in all
    directions, so neighbours in a row stand for all, and every third row of a large window for the others: to 4 % of
    the number, which is a tenth of the pixels [calc].
    """
    size, pixels = len(L), columns.shape[1]
    last = np.uint32(0)
    for p in range(pixels):
        last = max(last, where[0, p])
    wanted = np.zeros(last + 1, np.uint32)
    wanted[1 :: 1 if pixels < _LARGE_WINDOW else 3] = 1  # none in the corners of a window, where the padding is
    picked, used, every = np.empty(pixels, np.uint32), np.uint32(0), np.uint32(0)
    for p in range(pixels):
        picked[used] = p
        every += np.uint32(where[0, p] > np.uint32(0))
        used += wanted[where[0, p]]
    count = (int(used) + VECTOR - 1) // VECTOR * VECTOR
    of_row, of_column = np.zeros(count + LAGS, np.uint32), np.zeros(count + LAGS, np.uint32)
    for p in range(used):
        of_row[p], of_column[p] = where[0, picked[p]], where[1, picked[p]]
    shares, rows = np.zeros((LAGS + 1, count), np.float32), np.zeros((size, count + LAGS), np.float32)
    for lag in range(LAGS + 1):
        share, factor, one = shares[lag], np.float32(by_lag[lag] * every / max(used, 1)), np.uint32(lag)
        later_row, later_column = of_row[lag:], of_column[lag:]
        for p in range(count):
            beside = (later_row[p] == of_row[p]) & (later_column[p] == of_column[p] + one)
            share[p] = factor if beside else np.float32(0.0)
    s0, s1, s2, s3, s4 = shares[0], shares[1], shares[2], shares[3], shares[4]
    total = np.float32(0.0)
    for k in range(size):  # rows of L^-1 J'
        row, lower, column = rows[k], L[k], columns[k]
        scale = np.float32(1.0 / lower[k])
        for p in range(used):
            row[p] = scale * column[picked[p]]
        for m in range(0, k - 3, 4):  # four at once, which saves loads and stores
            a, b, c, d = rows[m], rows[m + 1], rows[m + 2], rows[m + 3]
            x, y = scale * np.float32(lower[m]), scale * np.float32(lower[m + 1])
            z, w = scale * np.float32(lower[m + 2]), scale * np.float32(lower[m + 3])
            for p in range(count):
                row[p] -= x * a[p] + y * b[p] + z * c[p] + w * d[p]
        for m in range(k - k % 4, k):
            part, other = scale * np.float32(lower[m]), rows[m]
            for p in range(count):
                row[p] -= part * other[p]
        r1, r2, r3, r4 = row[1:], row[2:], row[3:], row[4:]
        for p in range(count):
            total += row[p] * (s0[p] * row[p] + s1[p] * r1[p] + s2[p] * r2[p] + s3[p] * r3[p] + s4[p] * r4[p])
    return total


@exact
def _covariance(wanted, columns, where, L, side, correlation, scale2, prior, coupling, background, out):  # noqa: PLR0917
    """Write the covariance of u, v and the variance of the light in the middle into `out`, whose blur must be set.

    `wanted` (3,): the places of these parameters; a number of them that the compiler knows would unroll all loops
    here, and double its time. Propagated are noise of the given `correlation` and the uncertainty of the priors.
    """
    size = len(L)
    of_background = size - BACKGROUND_TERMS
    of_scatter = of_background - SCATTER_TERMS
    unit, influence = np.zeros(size), np.empty((len(wanted), size))
    for row in range(len(wanted)):
        unit[:] = 0.0
        unit[wanted[row]] = 1.0
        substitute(L, unit, influence[row])
    reach = np.uint32(LAGS)
    width, pixels = np.uint32(side) + 2 * reach, columns.shape[1]
    total = np.zeros((len(wanted), pixels), np.float32)
    field = np.zeros((len(wanted), width * width), np.float32)
    for row in range(len(wanted)):
        of_row, x = total[row], influence[row].astype(np.float32)
        for k in range(0, size - 3, 4):  # four at once, which saves loads and stores
            a, b, c, d = columns[k], columns[k + 1], columns[k + 2], columns[k + 3]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for p in range(pixels):
                of_row[p] += x0 * a[p] + x1 * b[p] + x2 * c[p] + x3 * d[p]
        for k in range(size - size % 4, size):
            column = columns[k]
            for p in range(pixels):
                of_row[p] += x[k] * column[p]
    for p in range(pixels):
        at = (where[0, p] + reach) * width + where[1, p] + reach
        field[0, at], field[1, at], field[2, at] = total[0, p], total[1, p], total[2, p]
    uu, uv, vv, ww = correlated_products(field, correlation, width)
    out[CUU], out[CUV], out[CVV], out[CCC] = scale2 * uu, scale2 * uv, scale2 * vv, scale2 * ww
    for m in range(SCATTER_TERMS - 1):
        for row in range(2):
            influence[row, of_scatter + 1 + m] -= coupling * influence[row, of_background + 1 + m]
    for k in range(size):
        # The prior pulls cubic terms to zero: their error is taken to be as large as their fitted values.
        m = k - of_background
        is_cubic = m >= BACKGROUND_TERMS - CUBIC_TERMS
        missing = prior[k] ** 2 * (background[m] ** 2 + _MIN_CUBIC**2) if is_cubic else prior[k]
        out[CUU] += influence[0, k] ** 2 * missing
        out[CUV] += influence[0, k] * influence[1, k] * missing
        out[CVV] += influence[1, k] ** 2 * missing
    bent = 1.0 + _RIM_NONLINEARITY * 0.5 * (out[CUU] + out[CVV]) / max(out[BLUR], MIN_BLUR_PX) ** 2
    out[CUU], out[CUV], out[CVV] = bent * out[CUU], bent * out[CUV], bent * out[CVV]


@exact
def unsharpen(beads, at, where, light, blur2, together2):  # noqa: PLR0917
    """Make `beads` and `at` those of the window before sharpening, which changed the squared blur by `blur2`.

    Returns the squared blur that background and shadow then went through together, as `fill_light` needs it.
    """
    for k in range(len(beads)):
        beads[k, BEAD_BLUR] = np.sqrt(max(beads[k, BEAD_BLUR] ** 2 - blur2, MIN_BLUR_PX**2))
    margin = np.uint32(MARGIN)
    for p in range(at.shape[1]):
        at[2, p] = light[where[0, p] + margin, where[1, p] + margin]
    return np.float32(together2 - blur2)


@part_of_caller
def assess(at, beads, gain, inverse_sd, pixels, behind, columns, out):  # noqa: PLR0917
    """Write into `out` how well the bead explains its window before sharpening: residual excess, weakest sector.

    `columns`: from `fill_light`, for beads and values before sharpening; `behind` (4, N) is overwritten.
    """
    darkest, zero = np.float32(0.02), np.float32(0.0)
    rest, meant_light, bright = columns[RESIDUAL], columns[LIGHT], columns[BACKGROUND]
    residuals = expected = zero
    for p in range(at.shape[1]):
        m, counts = max(meant_light[p], darkest), inverse_sd[p] > zero
        residual, sd = rest[p] / m, np.float32(1.0) / (inverse_sd[p] * m)
        residuals += residual * residual if counts else zero
        expected += sd * sd if counts else zero
    beyond = max(residuals - _NOISE_MARGIN * expected / gain, 0.0) / pixels
    out[EXCESS] = np.sqrt(beyond) / max(abs(out[CONTRAST]), 1e-9)
    u, v = np.float32(beads[0, BEAD_X]), np.float32(beads[0, BEAD_Y])
    rim2 = np.float32(squared(beads[0, BEAD_RADIUS] + 1))
    of_seen, of_meant, sectors = behind[0], behind[1], np.empty(at.shape[1], np.uint8)
    for p in range(at.shape[1]):  # without branches, so that it is vectorised
        x, y = at[0, p] - u, at[1, p] - v
        counts = (x * x + y * y < rim2) & (inverse_sd[p] > zero)
        bead = max(meant_light[p], darkest) / bright[p] - np.float32(1.0)
        of_seen[p] = (rest[p] / bright[p] + bead) * bead if counts else zero
        of_meant[p] = bead * bead if counts else zero
        sectors[p] = 4 * np.uint8(x > zero) + 2 * np.uint8(y > zero) + np.uint8(abs(x) > abs(y))
    seen, meant = np.zeros(8), np.zeros(8)
    for p in range(at.shape[1]):
        seen[sectors[p]] += of_seen[p]
        meant[sectors[p]] += of_meant[p]
    whole = 0.0
    for k in range(8):
        whole += meant[k]
    out[WEAKEST] = 1.0
    for k in range(8):
        if meant[k] > whole / 32:  # a sector that a neighbour covers is not judged
            out[WEAKEST] = min(out[WEAKEST], seen[k] / meant[k])
