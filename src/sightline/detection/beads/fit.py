"""Fit a bead by weighted least squares in its window, jointly with neighbours that overlap the window."""

from typing import NamedTuple

import numpy as np

from sightline.common.kernels import kernel
from sightline.detection.beads.bead import BeadStatus
from sightline.detection.beads.noise import LAGS
from sightline.detection.beads.shadow import (
    BACKGROUND,
    BACKGROUND_TERMS,
    BEAD_AXIAL,
    BEAD_BLUR,
    BEAD_DIAGONAL,
    BEAD_LARGE,
    BEAD_LIGHT,
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
    Derivatives,
    WindowModel,
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

# Kernels compute with the values of an enum.
FITTED, TOO_FEW_PIXELS, WANDERED, SINGULAR = map(int, BeadStatus)
LIGHT_STEPS = 32  # entries of the noise table per unit of light
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
# S.d. of BEAD_LIGHT: beam hardening and scatter change with a ball's size, so that two balls stop unlike shares [ours].
_LIGHT_SD = 0.05
CLIPPING_MARGIN_SD = 2.0  # of the noise, below the brightest value: 98 % of the pixels counted are not clipped [calc]
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


class Filter(NamedTuple):
    """A symmetric filter of an image and what it leaves.

    `taps` along both axes; `gain` of the noise's variance; `blur2_px2`: change of the squared blur; `shared_px2`:
    squared blur of background and shadow together. `correlation` of the noise after it, by lag along an axis;
    `by_distance` (LAGS + 1,): the correlations of all neighbours at about this distance.
    """

    taps: np.ndarray
    gain: float
    blur2_px2: float
    shared_px2: float
    correlation: np.ndarray
    by_distance: np.ndarray


class FitImage(NamedTuple):
    """An image as a fit needs it: `logs` (H, W), its log light, and the `usable` pixels (H, W); its noise and blur.

    `line` (3,): offset and slope of the noise, and the log intensity at which pixels are clipped. `inverse_sds`: one
    over the noise's s.d. at light 0 to 2, in units of that at 1, LIGHT_STEPS entries per unit. The filters, and the
    profiles of balls and of holes.
    """

    logs: np.ndarray
    usable: np.ndarray
    line: np.ndarray
    inverse_sds: np.ndarray
    sharpened: Filter
    plain: Filter
    balls: np.ndarray
    holes: np.ndarray


class FitWindow(NamedTuple):
    """The window of a fit: its `light` with a margin, the `state` (n, n) of each pixel, its first pixel and its reach.

    `zero`: log light of the image where `light` is 1.
    """

    light: np.ndarray
    state: np.ndarray
    left: int
    top: int
    reach: float
    zero: float


@kernel()
def joint_rows(spots, i, reach, prior_sd):
    """Return the rows of bead `i` and of the nearest beads that reach into its window: MAX_JOINT at most.

    A wide disc around bead `i` is anatomy, unless `prior_sd` says that its shape is known: then it is a ball.
    """
    own, gaps, rows, count = spots[i], np.empty(MAX_JOINT), np.empty(MAX_JOINT, np.int64), 1
    rows[0] = i
    for j in range(len(spots) if own.contrast <= 0 else 0):  # holes of a plate never overlap: neighbours are masked
        other = spots[j]
        if j == i or other.contrast > 0:
            continue
        du, dv, near = other.u_px - own.u_px, other.v_px - own.v_px, reach + other.radius_px + 2.0
        if not (abs(du) < near and abs(dv) < near):
            continue  # most spots are far away
        apart = np.hypot(du, dv)
        known = prior_sd[1, j, BEAD_RADIUS] < PRIOR_SD[1, BEAD_RADIUS]
        gap = apart - own.radius_px - other.radius_px
        if (not known and apart < other.radius_px - 0.5 * own.radius_px) or gap >= reach - own.radius_px + 2.0:
            continue
        k = min(count, MAX_JOINT - 1)
        if count == MAX_JOINT and gap >= gaps[k]:
            continue
        while k > 1 and gap < gaps[k - 1]:
            gaps[k], rows[k] = gaps[k - 1], rows[k - 1]
            k -= 1
        gaps[k], rows[k] = gap, j
        count = min(count + 1, MAX_JOINT)
    return rows[:count]


@kernel(nogil=True)
def fit_part(part, parts, scene, spots, which, prior_sd, fitted_beads):  # noqa: PLR0917 - a kernel
    """Fit the beads `which[part::parts]` of `spots` and write bead `which[i]` into row i of `fitted_beads`.

    Where a large residual remains, metal around the bead is searched for and hidden, and the fit is repeated.
    """
    trial = spots[:1].copy()
    for i in range(part, len(which), parts):
        row = which[i]
        u, v, radius = spots[row].u_px, spots[row].v_px, spots[row].radius_px
        reach = radius + BEYOND
        rows = joint_rows(spots, row, reach, prior_sd)
        half = int(reach) + 1
        left, top = int(u + 0.5) - half, int(v + 0.5) - half
        zero = log_level(scene.logs, scene.usable, u, v, radius, reach)
        light = window_light(scene.logs, left, top, half, zero)
        state = pixel_states(scene.logs, scene.usable, spots, rows, left, top, 2 * half + 1, scene.line[2])
        window = FitWindow(light, state, left, top, reach, zero)
        for attempt in range(2):
            trial[0] = spots[row]
            _fit(scene, spots, rows, prior_sd, window, trial)
            fitted = trial[0].status == FITTED
            better = fitted_beads[i].status != FITTED or trial[0].excess < fitted_beads[i].excess
            if attempt == 0 or (fitted and better):
                fitted_beads[i] = trial[0]
            if attempt == 1 or (fitted and trial[0].excess <= SUSPICIOUS_EXCESS) or spots[row].contrast > 0:
                break
            metal = hide_metal(state, spots, rows, left, top, light)
            if not metal or visible_rim(state, spots, rows, left, top) <= _MIN_RIM_SHARE:
                break


@kernel()
def _fit(scene, spots, rows, prior_sd, window, result):  # noqa: PLR0917 - a kernel
    """Fit the beads `rows` jointly to the visible pixels and write the first bead's values into `result` (1,)."""
    own, noise, zero = spots[rows[0]], scene.line, window.zero
    radius, x0, y0 = own.radius_px, own.u_px - window.left, own.v_px - window.top
    table, stopped = (scene.balls, STOPPED_BY_BALL) if own.contrast < 0 else (scene.holes, STOPPED_BY_HOLE)
    filtered = mark_near_unusable(window.state, x0, y0, radius) < MAX_RIM_LOST
    used = scene.sharpened if filtered else scene.plain
    values = along_both_axes(window.light, used.taps) if filtered else window.light
    at, where, counting = gather_pixels(window.state, filtered, values, x0, y0, window.reach)
    beads, scatter, background = initial_values(spots, rows, used.blur2_px2)
    model = WindowModel(table, at, beads, scatter, background, np.float32(1.0 / window.reach), stopped)
    size, pixels_held = (BEAD_TERMS + 1) * len(rows) - 1 + SCATTER_TERMS + BACKGROUND_TERMS, at.shape[1]
    columns, inverse_sd = np.empty((size + 3, pixels_held), np.float32), np.empty(pixels_held, np.float32)
    derivatives = Derivatives(
        columns, np.empty((4, pixels_held), np.float32), np.empty((len(rows), pixels_held), np.float32)
    )
    A, U, b = np.empty((size, size)), np.zeros((size, size)), np.empty(size)
    step, prior, initial, shared = np.zeros(size), np.zeros(size), beads.copy(), np.float32(used.shared_px2)
    unit = np.float32(1.0 / (np.exp(0.5 * (noise[0] - noise[1] * zero)) * np.sqrt(used.gain)))
    margin = CLIPPING_MARGIN_SD * np.exp(0.5 * (noise[0] - noise[1] * noise[2]))
    brightest = np.float32(np.exp(noise[2] - zero - margin))
    result[0].status, chi2, pixels, coupling, moved = TOO_FEW_PIXELS, 0.0, 0, 0.0, np.inf
    for iteration in range(_MAX_ITERATIONS):
        fill_light(model, shared, derivatives)
        if iteration < _ADAPTIVE_ITERATIONS:
            pixels = weigh(columns[LIGHT], counting, brightest, unit, scene.inverse_sds, inverse_sd)
        if pixels < 2 * size:
            return
        fill_slopes(at, model.scale, inverse_sd, derivatives)
        chi2 = normal_equations(columns, A, b)
        coupling = add_priors(model, initial, rows, prior_sd, prior, A, b)
        if not solve(A, b, U, step):
            result[0].status = SINGULAR
            return
        before = moved
        moved = _take_step(beads, scatter, background, step, 1.0 if iteration < _ADAPTIVE_ITERATIONS else 0.5)
        result[0].status = WANDERED
        away2, growth = beads[0, BEAD_X] ** 2 + beads[0, BEAD_Y] ** 2, beads[0, BEAD_RADIUS] / radius
        if away2 > (0.5 * radius + 1) ** 2 or not 0.5 < growth < 1.9:
            return
        if iteration == 0 or not (moved < _CONVERGED or moved * moved < _REMAINS * (before - moved)):
            continue
        if beads[0, BEAD_AXIAL] ** 2 + beads[0, BEAD_DIAGONAL] ** 2 > MAX_ELLIPTICITY**2:
            return
        result[0].status = FITTED
        break
    if result[0].status != FITTED:
        return
    freedom = max(pixels - _effective_parameters(columns, where, U, used.by_distance), 1.0)
    scale2, result[0].chi2 = (PRIOR_PIXELS + chi2) / (PRIOR_PIXELS + freedom), chi2 / freedom
    result[0].blur_px = np.sqrt(max(beads[0, BEAD_BLUR] ** 2 - used.blur2_px2, 0.0))
    _loosen_cubic(prior, background)
    _covariance(columns, where, U, len(window.state), used.correlation, scale2, prior, coupling, result)
    _write(own, model, result)
    unsharpen(beads, at, where, window.light, used.blur2_px2)
    fill_light(model, np.float32(used.shared_px2 - used.blur2_px2), derivatives)
    assess(at, beads, used.gain, inverse_sd, pixels, columns, result)


@kernel()
def _write(own, model, result):
    """Write the first bead of a `model` into `result`; `own`: its initial values, to which its centre is relative."""
    bead, background = model.beads[0], model.background
    inside = max((1.0 - model.stopped) * background[0] + model.scatter[0], 0.02 * background[0])
    result[0].contrast_variance /= inside**2
    result[0].u_px, result[0].v_px = own.u_px + bead[BEAD_X], own.v_px + bead[BEAD_Y]
    result[0].radius_px, result[0].contrast = bead[BEAD_RADIUS], np.log(inside / max(background[0], 1e-3))
    result[0].axial, result[0].diagonal = bead[BEAD_AXIAL], bead[BEAD_DIAGONAL]


@kernel()
def initial_values(spots, rows, blur2):
    """Return initial beads (K, BEAD_LIGHT + 1), relative to the first one's place, scatter and background."""
    own, beads = spots[rows[0]], np.zeros((len(rows), BEAD_LIGHT + 1))
    for k in range(len(rows)):
        bead, row = spots[rows[k]], beads[k]
        row[BEAD_X], row[BEAD_Y], row[BEAD_RADIUS] = bead.u_px - own.u_px, bead.v_px - own.v_px, bead.radius_px
        row[BEAD_BLUR] = np.sqrt(max(bead.blur_px**2 + blur2, 0.4**2))
        row[BEAD_AXIAL], row[BEAD_DIAGONAL], row[BEAD_LARGE] = bead.axial, bead.diagonal, bead.large
    scatter, background = np.zeros(SCATTER_TERMS), np.zeros(BACKGROUND_TERMS)
    background[0] = 1.0
    scatter[0] = np.exp(own.contrast) - (1.0 - STOPPED_BY_BALL if own.contrast < 0 else 1.0)
    return beads, scatter, background


@kernel()
def weigh(light, counting, brightest, unit, inverse_sds, inverse_sd):  # noqa: PLR0917 - a kernel
    """Fill `inverse_sd` with one over the noise's s.d. at the model's light; return how many pixels count.

    `unit` is its value at light 1. Zero, for pixels that do not count: those from `counting` on, and those that the
    model makes brighter than `brightest`, which may be clipped. The model decides, not the value seen: selecting by the
    value would keep the pixels with negative noise.
    """
    count, zero, steps, last = np.int32(0), np.float32(0.0), np.float32(LIGHT_STEPS), np.float32(2 * LIGHT_STEPS - 1)
    for p in range(len(inverse_sd)):
        at = np.uint32(np.int32(min(max(light[p] * steps, zero), last)))
        inverse_sd[p] = unit * inverse_sds[at] if light[p] < brightest else zero
    for p in range(counting, len(inverse_sd)):
        inverse_sd[p] = zero
    for p in range(len(inverse_sd)):
        count += np.int32(1) if inverse_sd[p] > zero else np.int32(0)
    return count


@kernel()
def add_priors(model, initial, rows, prior_sd, prior, A, b):  # noqa: PLR0917
    """Add the priors to the normal equations `A`, `b` and fill `prior` with their precisions (1 / s.d.²).

    Cubic terms and the light of neighbours are near zero; a bead's centre, shape and blur are near their initial
    values; scatter slopes follow the background's. Returns the coupling: expected scatter slope over background slope.
    """
    beads, scatter, background = model.beads, model.scatter, model.background
    prior[:] = 0.0
    for k in range(len(beads)):
        for m in range(BEAD_TERMS):
            sd = prior_sd[min(k, 1), rows[k], m] * (abs(initial[k, m]) if BEAD_RADIUS <= m < BEAD_AXIAL else 1.0)
            prior[BEAD_TERMS * k + m] = 1.0 / sd**2
            b[BEAD_TERMS * k + m] += (initial[k, m] - beads[k, m]) / sd**2
    for k in range(1, len(beads)):
        prior[BEAD_TERMS * len(beads) + k - 1] = 1.0 / _LIGHT_SD**2
        b[BEAD_TERMS * len(beads) + k - 1] -= beads[k, BEAD_LIGHT] / _LIGHT_SD**2
    to, slope = len(b) - BACKGROUND_TERMS + 1, np.hypot(background[1], background[2])
    at = to - SCATTER_TERMS
    share = scatter[0] * min(1.0, _MAX_SLOPE / max(slope, 1e-9))
    coupling, sd2 = _COUPLING * share, (_COUPLING_SD * share * slope) ** 2 + (_UNCOUPLED_SD * scatter[0]) ** 2 + 1e-6
    for m in range(SCATTER_TERMS - 1):
        off = (coupling * background[1 + m] - scatter[1 + m]) / sd2
        prior[at + m] = 1.0 / sd2
        b[at + m] += off
        b[to + m] -= coupling * off
        A[at + m, to + m] -= coupling / sd2
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


@kernel()
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
    for k in range(1, len(beads)):
        beads[k, BEAD_LIGHT] = min(max(beads[k, BEAD_LIGHT] + step[BEAD_TERMS * len(beads) + k - 1], -0.3), 0.3)
    at = (BEAD_TERMS + 1) * len(beads) - 1
    for m in range(SCATTER_TERMS):
        scatter[m] += min(max(step[at + m], -0.5), 0.5)
    for m in range(BACKGROUND_TERMS):
        background[m] += step[at + SCATTER_TERMS + m]
    return max(abs(step[BEAD_X]), abs(step[BEAD_Y]), abs(step[BEAD_RADIUS]), abs(step[at]))


@kernel()
def _effective_parameters(columns, where, U, by_lag):  # noqa: PLR0912 - a kernel
    """Return the effective number of parameters: tr(H C) with the projection H = J A^-1 J' and the noise correlation C.

    The fit lowers the expected sum of squared residuals by so much. For white noise it is the number of parameters.
    `U`: the upper Cholesky factor of A; `by_lag` (LAGS + 1,): the correlations of all neighbours at about this
    distance. H is nearly the same in all directions, so neighbours in a row stand for all, and every third row of a
    large window for the others: to 4 % of the number, which is a tenth of the pixels [calc].
    """
    size, pixels = len(U), columns.shape[1]
    picked, used, every, stride = np.empty(pixels, np.int64), 0, 0, 1 if pixels < _LARGE_WINDOW else 3
    for p in range(pixels):  # row 0 has none: it lies in the corners of a window, where the padding is
        every += where[0, p] > 0
        if where[0, p] > 0 and (where[0, p] - 1) % stride == 0:
            picked[used] = p
            used += 1
    count = (used + VECTOR - 1) // VECTOR * VECTOR
    shares, rows = np.zeros((LAGS + 1, count), np.float32), np.zeros((size, count + LAGS), np.float32)
    for lag in range(LAGS + 1):
        for k in range(used - lag):
            p, q = picked[k], picked[k + lag]
            if where[0, p] == where[0, q] and where[1, p] + lag == where[1, q]:
                shares[lag, k] = by_lag[lag] * every / used
    products, total = np.zeros(count, np.float32), 0.0
    for k in range(size):  # rows of U^-T J
        row, column = rows[k], columns[k]
        for p in range(used):
            row[p] = column[picked[p]]
        for m in range(k):
            part, other = np.float32(U[m, k]), rows[m]
            for p in range(count):
                row[p] -= part * other[p]
        scale = np.float32(1.0 / U[k, k])
        for p in range(count):
            row[p] *= scale
        for lag in range(LAGS + 1):
            share, later = shares[lag], row[lag:]
            for p in range(count):
                products[p] += share[p] * row[p] * later[p]
    for p in range(count):
        total += products[p]
    return total


@kernel()
def _loosen_cubic(prior, background):
    """Change the precisions of the cubic terms: their error is taken to be as large as their fitted values.

    The prior pulls them to zero.
    """
    for m in range(BACKGROUND_TERMS - CUBIC_TERMS, BACKGROUND_TERMS):
        k = len(prior) - BACKGROUND_TERMS + m
        prior[k] = prior[k] ** 2 * (background[m] ** 2 + _MIN_CUBIC**2)


@kernel()
def _covariance(columns, where, U, side, correlation, scale2, prior, coupling, result):  # noqa: PLR0917 - a kernel
    """Write the covariance of u, v and the variance of the light in the middle into `result`, whose blur must be set.

    Propagated are noise of the given `correlation` and the uncertainty of the priors.
    """
    size = len(U)
    of_background = size - BACKGROUND_TERMS
    of_scatter = of_background - SCATTER_TERMS
    unit, influence = np.zeros(size), np.empty((3, size))
    for row in range(3):
        wanted = BEAD_X if row == 0 else BEAD_Y if row == 1 else of_scatter
        unit[:] = 0.0
        unit[wanted] = 1.0
        substitute(U, unit, influence[row])
    total = np.dot(influence.astype(np.float32), columns[:size])
    width = side + 2 * LAGS
    field = np.zeros((3, width * width), np.float32)
    for p in range(columns.shape[1]):
        at = (int(where[0, p]) + LAGS) * width + int(where[1, p]) + LAGS
        for row in range(3):
            field[row, at] = total[row, p]
    uu, uv, vv, ww = correlated_products(field, correlation, width)
    for m in range(SCATTER_TERMS - 1):
        for row in range(2):
            influence[row, of_scatter + 1 + m] -= coupling * influence[row, of_background + 1 + m]
    uu, uv, vv, ww = scale2 * uu, scale2 * uv, scale2 * vv, scale2 * ww
    for k in range(size):
        uu += influence[0, k] ** 2 * prior[k]
        uv += influence[0, k] * influence[1, k] * prior[k]
        vv += influence[1, k] ** 2 * prior[k]
    bent = 1.0 + _RIM_NONLINEARITY * 0.5 * (uu + vv) / max(result[0].blur_px, MIN_BLUR_PX) ** 2
    result[0].uu_px2, result[0].uv_px2, result[0].vv_px2, result[0].contrast_variance = (
        bent * uu,
        bent * uv,
        bent * vv,
        ww,
    )


@kernel()
def unsharpen(beads, at, where, light, blur2):
    """Make `beads` and `at` those of the window before sharpening, which changed the squared blur by `blur2`."""
    for k in range(len(beads)):
        beads[k, BEAD_BLUR] = np.sqrt(max(beads[k, BEAD_BLUR] ** 2 - blur2, MIN_BLUR_PX**2))
    for p in range(at.shape[1]):
        at[2, p] = light[int(where[0, p]) + MARGIN, int(where[1, p]) + MARGIN]


@kernel()
def assess(at, beads, gain, inverse_sd, pixels, columns, result):  # noqa: PLR0917 - a kernel
    """Write into `result` how well the bead explains its window before sharpening: residual excess, weakest sector.

    `columns`: from `fill_light`, for beads and values before sharpening.
    """
    rest, light, bright = columns[RESIDUAL], columns[LIGHT], columns[BACKGROUND]
    u, v, rim2 = beads[0, BEAD_X], beads[0, BEAD_Y], (beads[0, BEAD_RADIUS] + 1) ** 2
    residuals = expected = 0.0
    seen, meant = np.zeros(8), np.zeros(8)
    for p in range(at.shape[1]):
        if inverse_sd[p] == 0.0:
            continue
        here = max(light[p], np.float32(0.02))
        residuals += (rest[p] / here) ** 2
        expected += 1.0 / (inverse_sd[p] * here) ** 2
        x, y = at[0, p] - u, at[1, p] - v
        if x * x + y * y < rim2:
            bead = here / bright[p] - 1.0
            sector = 4 * int(x > 0) + 2 * int(y > 0) + int(abs(x) > abs(y))
            seen[sector] += (rest[p] / bright[p] + bead) * bead
            meant[sector] += bead * bead
    beyond = max(residuals - _NOISE_MARGIN * expected / gain, 0.0) / pixels
    result[0].excess = np.sqrt(beyond) / max(abs(result[0].contrast), 1e-9)
    weakest, whole = 1.0, 0.0
    for k in range(8):
        whole += meant[k]
    for k in range(8):
        if meant[k] > whole / 32:  # a sector that a neighbour covers is not judged
            weakest = min(weakest, seen[k] / meant[k])
    result[0].weakest = weakest
