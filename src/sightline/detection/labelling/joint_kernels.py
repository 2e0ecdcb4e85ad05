"""Kernels of the joint fit of both plates: the map, the focal point, and the beads that fit them.

They compute in the sheet's coordinates: places and focal point are (x, y, height) over the XRII plate, from the field's
centre in units of its radius. Only labels follow from these numbers, no estimate.
"""

from typing import NamedTuple

import numpy as np

from sightline.fitting.dense import PIVOTS, STRIDE, eliminate, factor
from sightline.fitting.robust import MEDIAN_M2
from sightline.geometry.lines import SPREAD_RAD
from sightline.kernels import exact_unchecked, fast, squared

MIN_BEADS = 8  # of each plate [ours]
MIN_BEYOND = 0.1  # smallest distance of the focal point beyond the source plate, over that between the plates [ours]
GATE_M2 = 11.3  # squared Mahalanobis distance in place and radius: 99 %, 3 degrees of freedom [ours]
NEAR_M2 = 24.0  # detections or places as near as this can be confused with each other [ours]
MAX_FITS, NOISE_FITS = 10, 3  # iterations, and those in which the noise is estimated
SAME_NOISE = 0.1  # relative change of the noise that needs no further fit [ours]
MAX_NOISE = 100.0  # times the stated variance [ours]; rendered images have up to 3.5; 1 would lose 7 % of the beads
SAME_DISTANCE = 1e-6  # relative, of two squares that rounding alone tells apart


class Spots(NamedTuple):
    """N detections: sheet coordinates `w` (N, 2), prior covariance of the map there, `kernel` (N, N), `noise` (N,).

    `size_m2` (N, P): squared misfit of each detection's radius on each place; `usable` (N,) bool.
    """

    w: np.ndarray
    kernel: np.ndarray
    noise: np.ndarray
    size_m2: np.ndarray
    usable: np.ndarray


class Places(NamedTuple):
    """P places `xyh` (P, 3), those of the XRII plate, `on_xrii` of them, before those of the source plate.

    `focal_sd`: prior s.d. per axis of the focal point's step.
    """

    xyh: np.ndarray
    on_xrii: int
    focal_sd: float


class Fitted(NamedTuple):
    """A fit: `focal` (3,), and of every detection `at` (N, 2), predicted without itself, and `variance` (N,).

    The variance is that of either coordinate, with the detection's noise. `target` (P, 2): the places projected from
    `focal`. `dual` (N, 2): the map less identity is kernel @ dual.
    """

    focal: np.ndarray
    at: np.ndarray
    variance: np.ndarray
    target: np.ndarray
    dual: np.ndarray


class _Work(NamedTuple):
    """What a fit of n beads holds on the way, in arrays with space for all N detections.

    V is the covariance of either coordinate. The derivatives of a bead's coordinates by the focal point are (s, 0, g_x)
    and (0, s, g_y), so that five vectors r determine the fit: x, y, s, g_x and g_y. `inverse` (N, N): of V's lower
    Cholesky factor; `solved` (5, N): V^-1 r; `products` (5, 5): r^T V^-1 r, upper triangle. `spread` (3, 3): the factor
    of the covariance of the focal point's step. `m2` (N,): squared leave-one-out Mahalanobis distances of the beads.
    """

    inverse: np.ndarray
    solved: np.ndarray
    products: np.ndarray
    spread: np.ndarray
    m2: np.ndarray


@exact_unchecked
def _factor_of_inverse(a, c, e, f, out):
    """Fill `out` (3, 3) with the Cholesky factor of the inverse of [[a, 0, c], [0, a, e], [c, e, f]]."""
    det = a * a * f - a * (c * c + e * e)
    out[:] = 0.0
    out[0, 0] = np.sqrt((a * f - e * e) / det)
    out[1, 0], out[2, 0] = c * e / det / out[0, 0], -a * c / det / out[0, 0]
    out[1, 1] = np.sqrt((a * f - c * c) / det - out[1, 0] ** 2)
    out[2, 1] = (-a * e / det - out[2, 0] * out[1, 0]) / out[1, 1]
    out[2, 2] = np.sqrt(a * a / det - out[2, 0] ** 2 - out[2, 1] ** 2)


@exact_unchecked
def median_of(values, count):
    """Return the median of the first `count` values, which are sorted."""
    for n in range(1, count):
        one, k = values[n], n
        while k > 0 and values[k - 1] > one:
            values[k] = values[k - 1]
            k -= 1
        values[k] = one
    return (values[(count - 1) // 2] + values[count // 2]) / 2


@exact_unchecked
def _sees(places, focal):
    """Return whether a focal point lies beyond the source plate, seen from the XRII plate."""
    behind = False
    for p in range(places.on_xrii, len(places.xyh)):
        behind |= not focal[2] / places.xyh[p, 2] > 1.0 + MIN_BEYOND
    return not behind


@exact_unchecked
def _project(places, focal, target):
    """Fill `target` (P, 2): the places projected from a focal point; those of the XRII plate have no height."""
    for p in range(len(target)):
        share = places.xyh[p, 2] / (places.xyh[p, 2] - focal[2])
        for c in range(2):
            target[p, c] = places.xyh[p, c] + share * (focal[c] - places.xyh[p, c])


@exact_unchecked
def _match(fit, growth, spots, on):
    """Fill `on` with the place (N,) of each usable detection within the gate, or -1 where there is none or several.

    `growth`: of the fit's variances.
    """
    target, m2 = fit.target, np.empty(len(fit.target))
    rivals = np.zeros(len(target), np.int64)
    for n in range(len(on)):
        on[n], near, x, y, variance = -1, 0, fit.at[n, 0], fit.at[n, 1], growth * fit.variance[n]
        for p in range(len(m2)):  # vectorised; few are near
            m2[p] = ((x - target[p, 0]) ** 2 + (y - target[p, 1]) ** 2) / variance
        for p in range(len(m2) if spots.usable[n] else 0):
            if m2[p] < NEAR_M2 and m2[p] + spots.size_m2[n, p] < NEAR_M2:
                near += 1
                rivals[p] += 1
                if m2[p] + spots.size_m2[n, p] < GATE_M2:
                    on[n] = p
        if near > 1:
            on[n] = -1
    for n in range(len(on)):
        if on[n] >= 0 and rivals[on[n]] > 1:
            on[n] = -1


@exact_unchecked
def _fewest(on, places):
    """Return the smaller number of beads of one plate."""
    xrii = source = 0
    for p in on:
        xrii += 0 <= p < places.on_xrii
        source += p >= places.on_xrii
    return xrii if places.on_xrii == len(places.xyh) else min(xrii, source)


@exact_unchecked
def _solve(beads, spots, places, fit, growth, work):  # noqa: PLR0917 - a kernel
    """Fill `inverse`, `solved` and `products` of `work`; return whether V is positive definite."""
    kernel, xyh, focal, n = spots.kernel, places.xyh, fit.focal, len(beads)
    first = (n + PIVOTS - 1) // PIVOTS * PIVOTS  # column of the first of the vectors
    matrix = np.zeros((first + 6, (2 * first + 5 + STRIDE - 1) // STRIDE * STRIDE))  # [[V, r, 1], [., 0, 0]]
    for i in range(first):
        matrix[i, i] = matrix[i, first + 5 + i] = 1.0
    for i in range(n):
        row, p, own = beads[i, 0], beads[i, 1], matrix[i]
        for j in range(i, n):
            own[j] = kernel[row, beads[j, 0]]
        own[i] += growth * spots.noise[row]
        share = xyh[p, 2] / (xyh[p, 2] - focal[2])
        own[first + 2] = places.focal_sd * share
        for c in range(2):
            own[first + c] = fit.target[p, c] - spots.w[row, c]
            own[first + 3 + c] = places.focal_sd * share * (focal[c] - xyh[p, c]) / (xyh[p, 2] - focal[2])
    if not eliminate(first, first + 5, matrix):
        return False
    for i in range(n):
        for j in range(i + 1):
            work.inverse[i, j] = matrix[i, first + 5 + j]
    for r in range(5):
        for c in range(r, 5):
            work.products[r, c] = -matrix[first + r, first + c]
        for j in range(n):
            work.solved[r, j] = -matrix[first + r, first + 5 + j]
    return True


@exact_unchecked
def _move(n, places, fit, work):
    """Move the focal point by its step, the targets with it, and take its part from the map; fill `spread`."""
    (u, v, a, bx, by), products = work.solved, work.products
    ss, sx, sy, gg = 1.0 + products[2, 2], products[2, 3], products[2, 4], 1.0 + products[3, 3] + products[4, 4]
    p, q, r = products[0, 2], products[1, 2], products[0, 3] + products[1, 4]
    spread = work.spread
    _factor_of_inverse(ss, sx, sy, gg, spread)
    along = (
        spread[0, 0] * p + spread[1, 0] * q + spread[2, 0] * r,
        spread[1, 1] * q + spread[2, 1] * r,
        spread[2, 2] * r,
    )
    p = spread[0, 0] * along[0]
    q = spread[1, 0] * along[0] + spread[1, 1] * along[1]
    r = spread[2, 0] * along[0] + spread[2, 1] * along[1] + spread[2, 2] * along[2]
    for i in range(n):
        u[i] -= a[i] * p + bx[i] * r
        v[i] -= a[i] * q + by[i] * r
    fit.focal[0] -= places.focal_sd * p
    fit.focal[1] -= places.focal_sd * q
    fit.focal[2] -= places.focal_sd * r
    _project(places, fit.focal, fit.target)


@exact_unchecked
def _leave_out(beads, fit, work):
    """Fill place and variance of the beads, each predicted without itself, and their `m2`."""
    (u, v, a, bx, by), spread, own = work.solved, work.spread, work.m2
    for j in range(len(beads)):
        own[j] = 0.0
    for i in range(len(beads)):
        for j in range(i + 1):
            own[j] += work.inverse[i, j] ** 2  # the diagonal of V^-1
    for i in range(len(beads)):
        row, p = beads[i, 0], beads[i, 1]
        xx, xy, yy = own[i], 0.0, own[i]
        for k in range(3):
            x, y = a[i] * spread[0, k] + bx[i] * spread[2, k], a[i] * spread[1, k] + by[i] * spread[2, k]
            xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
        det = xx * yy - xy * xy
        off_x, off_y = (yy * u[i] - xy * v[i]) / det, (xx * v[i] - xy * u[i]) / det
        fit.at[row, 0], fit.at[row, 1] = fit.target[p, 0] - off_x, fit.target[p, 1] - off_y
        fit.variance[row], own[i] = (xx + yy) / (2 * det), u[i] * off_x + v[i] * off_y
        fit.dual[row, 0], fit.dual[row, 1] = u[i], v[i]


@fast
def _predict(n, spots, beads, growth, fit, work):  # noqa: PLR0917 - a kernel
    """Fill place and variance of detection `n`, which is not a bead."""
    solved, cross, sums = work.solved, np.empty(len(beads)), np.zeros(5)
    for j in range(len(beads)):
        cross[j] = spots.kernel[n, beads[j, 0]]
    for r in range(5):
        for j in range(len(beads)):
            sums[r] += cross[j] * solved[r, j]
    variance = spots.kernel[n, n] + growth * spots.noise[n]
    for i in range(len(beads)):
        back = 0.0
        for j in range(i + 1):
            back += work.inverse[i, j] * cross[j]
        variance -= back * back
    for k in range(3):
        x = sums[2] * work.spread[0, k] + sums[3] * work.spread[2, k]
        y = sums[2] * work.spread[1, k] + sums[4] * work.spread[2, k]
        variance += (x * x + y * y) / 2
    fit.at[n, 0], fit.at[n, 1], fit.variance[n] = spots.w[n, 0] + sums[0], spots.w[n, 1] + sums[1], variance
    fit.dual[n, 0] = fit.dual[n, 1] = 0.0


@fast
def _step(on, spots, places, fit, growth, work):  # noqa: PLR0917 - a kernel
    """Replace the fit by that of the beads `on` (N,) after one Gauss-Newton step; return their number, or 0.

    0 where their covariance is not positive definite.
    """
    count, all_beads = 0, np.empty((len(on), 2), np.int64)
    for n in range(len(on)):
        if on[n] >= 0:
            all_beads[count, 0], all_beads[count, 1] = n, on[n]
            count += 1
    beads = all_beads[:count]
    _project(places, fit.focal, fit.target)
    if not _solve(beads, spots, places, fit, growth, work):
        return 0
    _move(len(beads), places, fit, work)
    _leave_out(beads, fit, work)
    for n in range(len(on)):
        if on[n] < 0:
            _predict(n, spots, beads, growth, fit, work)
    return len(beads)


@fast
def first_focal(places, at, on):
    """Return the point (3,) nearest to the lines from the source beads through their images on the XRII plate.

    `at` (N, 2): the detections, mapped to the XRII plate; `on` (N,): their places, or -1. The origin, where `_sees`
    refuses it, if the lines are nearly parallel; with one plate any point.
    """
    normal, focal, count = np.zeros((3, 3)), np.zeros(3), 0  # least squares: normal @ point = focal
    if places.on_xrii == len(places.xyh):
        focal[2] = 1.0
        return focal
    for n in range(len(on)):
        if on[n] < places.on_xrii:
            continue
        count += 1
        x, y, h = places.xyh[on[n], 0], places.xyh[on[n], 1], places.xyh[on[n], 2]
        dx, dy = x - at[n, 0], y - at[n, 1]
        square = dx * dx + dy * dy + h * h
        share = (x * dx + y * dy + h * h) / square  # to the point of the line that is nearest to the origin
        along, foot = (dx, dy, h), (x - share * dx, y - share * dy, h - share * h)
        for i in range(3):
            focal[i] += foot[i]
            normal[i, i] += 1.0
            for k in range(i + 1):
                normal[i, k] -= along[i] * along[k] / square
    if not factor(3, normal) or squared(normal[2, 2]) < count * squared(SPREAD_RAD):
        focal[:] = 0.0
        return focal
    for i in range(3):
        for k in range(i):
            focal[i] -= normal[i, k] * focal[k]
        focal[i] /= normal[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            focal[i] -= normal[k, i] * focal[k]
        focal[i] /= normal[i, i]
    return focal


@fast
def settle(spots, places, at, on):
    """Fit and match in turns until beads and noise stay; `on` (N,), the place of each detection or -1, is replaced.

    Begin at `first_focal` of `at` (N, 2), and return the fit, and whether it settled.
    """
    n, focal = len(on), first_focal(places, at, on)
    fit = Fitted(focal, np.empty((n, 2)), np.empty(n), np.empty((len(places.xyh), 2)), np.empty((n, 2)))
    work = _Work(np.empty((n, n)), np.empty((5, n)), np.empty((5, 5)), np.empty((3, 3)), np.empty(n))
    new, growth = on.copy(), 1.0
    for iteration in range(MAX_FITS if _sees(places, focal) else 0):
        count, before = _step(on, spots, places, fit, growth, work), growth
        if count == 0:
            break
        if iteration < NOISE_FITS:  # later, gating has cut off the tails, and the noise would be underestimated
            growth = min(max(growth * median_of(work.m2, count) / MEDIAN_M2, 1.0), MAX_NOISE)
        _match(fit, growth / before, spots, new)
        changed = 0
        for k in range(n):
            if iteration >= NOISE_FITS and new[k] != on[k]:  # from here beads are only removed, so the loop terminates
                new[k] = -1
            changed += new[k] != on[k]
        if iteration and changed == 0 and abs(growth - before) < SAME_NOISE * before:
            return fit, True
        for k in range(n):  # a copy of arrays takes numba 2 s to compile, for the message that their sizes differ
            on[k] = new[k]
        if _fewest(on, places) < MIN_BEADS or not _sees(places, fit.focal):
            break
    return fit, False


@exact_unchecked
def empty_near(target, places, count):
    """Return the share (B,) of places near each of `places` (B,) that are not among these, with one more of each kind.

    `target` (P, 2). Near are the `count` nearest ones and all that are as far as the last of them but for rounding: on
    a grid there are several, and rounding must not choose among them.
    """
    free = np.ones(len(target), np.bool_)
    for p in places:
        free[p] = False
    off2, near2, out = np.empty(len(target)), np.empty(count), np.empty(len(places))
    for b in range(len(places)):
        near2[:] = np.inf
        x, y = target[places[b], 0], target[places[b], 1]
        for p in range(len(target)):  # vectorised, like the sums below
            off2[p] = (target[p, 0] - x) ** 2 + (target[p, 1] - y) ** 2
        off2[places[b]] = np.inf
        for p in range(len(target)):
            if off2[p] < near2[count - 1]:
                k = count - 1
                while k > 0 and near2[k - 1] > off2[p]:
                    near2[k] = near2[k - 1]
                    k -= 1
                near2[k] = off2[p]
        within, empty, limit = 0, 0, (1.0 + SAME_DISTANCE) * near2[count - 1]
        for p in range(len(target)):
            near = off2[p] < limit
            within += near
            empty += near & free[p]
        out[b] = (empty + 1.0) / (within + 2.0)
    return out


@exact_unchecked
def nearest_squares(at, target):
    """Return the squared distance (N,) of each of `at` (N, 2) from the nearest of `target` (P, 2)."""
    out = np.full(len(at), np.inf)
    for n in range(len(at)):
        for p in range(len(target)):
            out[n] = min(out[n], (at[n, 0] - target[p, 0]) ** 2 + (at[n, 1] - target[p, 1]) ** 2)
    return out
