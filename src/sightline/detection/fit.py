"""The fit of a bead: weighted least squares in its window, jointly with beads that touch it."""

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
    EXCESS,
    FITTED,
    RADIUS,
    SINGULAR,
    STATUS,
    TOO_FEW_PIXELS,
    WANDERED,
    WEAKEST,
    U,
    V,
)
from sightline.detection.compiled import FAST, exact, exact_unchecked, part_of_caller
from sightline.detection.shadow import (
    BEAD,
    CUBIC,
    GROUND,
    SCATTER,
    TAKEN_BY_BALL,
    TAKEN_BY_HOLE,
    fill_light,
    fill_slopes,
    normal_equations,
    solve,
    substitute,
)
from sightline.detection.window import (
    BEYOND,
    MARGIN,
    along_both_axes,
    gather,
    hide_metal,
    in_one_row,
    level,
    look,
    mark,
    rim_seen,
    spread,
)

_LIGHTS = 32  # steps per unit of light
_MOST = 3  # beads of a joint fit
_STEPS = 12
_CHOOSING = 4  # steps after which weights and choice of pixels stay, and steps are halved: they would take turns [ours]
_SETTLED = (
    0.02  # px, and share of light: a step as small as that is a tenth of the noise or less, and the next one nothing
)
_PRIOR_PIXELS = 50.0  # weight of the noise model against the bead's own residuals, in pixels [ours]
_LEAST_BLUR = 0.3  # px; a pixel alone blurs by 0.29
_CUBIC = 0.06  # s.d. of a background's cubic terms at the window's rim, share of its light [twin: hard scenes]
# Slope of the scatter in shares of its level: from that of an even veil to that of light which follows the background,
# and a little that has to do with neither. With TAKEN_BY_BALL the light behind a ball slopes half as steeply as the
# background, with a s.d. as large: 0.03-0.4 of its slope instead of 0-0.5 [twin: kernels of 8 mm to even].
_FOLLOWS, _FOLLOWS_SD, _UNLIKE = 0.35, 0.5, 0.01
# Of the background, per window: what is steeper is the edge of a bone, which scatter does not follow [twin]; and where
# the background is clipped, its slope is not known.
_STEEPEST = 0.1
_FLAT = 0.005  # the least that is taken for them where the fit shows less [ours]
_ELLIPTIC = 0.05  # s.d. of a shadow's ellipticity: distortion and the slant of the rays make 0.00-0.08 [twin]
# S.d. of the other terms, which matters where the background is clipped [ours].
_VAGUE = np.array([1.0, 0.5, 0.5, 0.3, 0.3, 0.3])
_NEARLY_CLIPPED = 2.0  # s.d. of the noise under the brightest value [ours]
_UNEXPLAINED = 0.05  # residual beyond noise over contrast: clear beads have 0.00-0.04 [twin]
_LEAST_RIM = 0.7  # share of it that metal must leave: the straight sides of a wire pass for shorter arcs [ours]
_SPREAD_OF_NOISE = 1.3  # times the expected square of the residuals, which noise alone may reach [ours]
_LONGEST = 0.12  # ellipticity: beads in images up to 0.09, pieces of wire more [twin]
# Covariance beyond what is linear in the noise, in units of the centre's variance over the blur's square [twin].
_RIM_BENDS = 3.0
_LOST = 0.15  # share of the rim that sharpening may cost, before a window is left as it is [ours]
# What is known of a bead and of its neighbours from where they start, s.d.: px, px, share of radius, of blur [ours].
_ITSELF = np.array([2.0, 2.0, 0.2, 0.5])
_NEIGHBOUR = np.array([0.7, 0.7, 0.06, 0.3])


@exact
def _copy(values, out):
    for k in range(len(out)):  # an assignment to out[:] would take seconds to compile
        out[k] = values[k]


@exact
def _group(spots, i, reach):
    """Rows of the beads to be fitted with bead `i`, itself first: the nearest of those that reach into its window."""
    rows, gaps = np.empty(_MOST, np.int64), np.empty(_MOST)
    rows[:], rows[0] = -1, i
    if spots[i, CONTRAST] > 0:
        return rows[:1]  # the holes of a plate never overlap: another one's place is masked
    gaps[:] = reach - spots[i, RADIUS] + 2.0
    for j in range(len(spots)):
        if j == i or spots[j, CONTRAST] * spots[i, CONTRAST] < 0:
            continue
        apart = np.hypot(spots[j, U] - spots[i, U], spots[j, V] - spots[i, V])
        if apart < spots[j, RADIUS] - 0.5 * spots[i, RADIUS]:
            continue  # a wide disc about this bead is structure
        gap = apart - spots[i, RADIUS] - spots[j, RADIUS]
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


@part_of_caller
def _solve(spots, rows, noise, sharpening, plain, tables, light, state, window, out):  # noqa: PLR0917
    """Fit the beads `rows` to the pixels that are seen; the first one's answer goes into `out`."""
    left, top, reach, zero = window
    row, radius = rows[0], spots[rows[0], RADIUS]
    table, taken = (tables[0], TAKEN_BY_BALL) if spots[row, CONTRAST] < 0 else (tables[1], TAKEN_BY_HOLE)
    size = BEAD * len(rows) + SCATTER + GROUND
    x0, y0 = spots[row, U] - left, spots[row, V] - top
    filtered = spread(state, x0, y0, radius) < _LOST
    taps, gain, blur2, together2, after = sharpening if filtered else plain
    at, where, counting = gather(state, filtered, along_both_axes(light, taps) if filtered else light, x0, y0, reach)
    beads, scatter, ground = _start(spots, rows, blur2)
    first = beads.copy()
    columns, root = np.empty((size + 3, at.shape[1]), np.float32), np.empty(at.shape[1], np.float32)
    behind, effect = np.empty((4, at.shape[1]), np.float32), np.empty((len(rows), at.shape[1]), np.float32)
    A, L, b, step = np.empty((size + 2, size + 2)), np.empty((size, size)), np.empty(size), np.zeros(size)
    known = np.zeros(size)
    optics = np.float32(1.0 / reach), taken, np.float32(together2)
    roots = _roots(np.exp(0.5 * (noise[0] - noise[1] * zero)) * np.sqrt(gain), noise[1])
    brightest = np.exp(noise[2] - zero - _NEARLY_CLIPPED * np.exp(0.5 * (noise[0] - noise[1] * noise[2])))
    out[STATUS] = TOO_FEW_PIXELS
    chi2, pixels, follows = 0.0, 0, 0.0
    for turn in range(_STEPS):
        fill_light(table, at, beads, scatter, ground, optics, behind, effect, columns)
        if turn < _CHOOSING:
            pixels = _weigh(columns[-2], counting, np.float32(brightest), roots, root)
        if pixels < 2 * size:
            return
        fill_slopes(at, optics[0], root, behind, effect, columns)
        chi2 = normal_equations(columns, A, b)
        follows = _rely_on_what_is_known(beads, first, scatter, ground, known, A, b)
        if not solve(A, b, L, step):
            out[STATUS] = SINGULAR
            return
        moved = _move(beads, scatter, ground, step, 1.0 if turn < _CHOOSING else 0.5)
        out[STATUS] = WANDERED
        if np.hypot(beads[0, 0], beads[0, 1]) > 0.5 * radius + 1 or not 0.5 < beads[0, 2] / radius < 1.9:
            return
        if moved < _SETTLED and turn > 0:
            out[STATUS] = FITTED
            break
    if out[STATUS] != FITTED or np.hypot(beads[0, 4], beads[0, 5]) > _LONGEST:
        out[STATUS] = max(out[STATUS], WANDERED)
        return
    freedom = max(pixels - _absorbed(columns, where, L, len(state), after), 1.0)
    out[CHI2], scale2 = chi2 / freedom, (_PRIOR_PIXELS + chi2) / (_PRIOR_PIXELS + freedom)
    out[BLUR] = np.sqrt(max(beads[0, 3] ** 2 - blur2, 0.0))
    _covariance(columns, where, L, len(state), after, scale2, known, follows, ground, out)
    inside = max((1.0 - taken) * ground[0] + scatter[0], 0.02 * ground[0])
    out[CCC] /= inside**2
    out[U], out[V], out[RADIUS] = spots[row, U] + beads[0, 0], spots[row, V] + beads[0, 1], beads[0, 2]
    out[CONTRAST] = np.log(inside / max(ground[0], 1e-3))
    blurs, room = (blur2, together2), (behind, effect, columns)
    _judge(table, at, where, light, beads, scatter, ground, optics, blurs, gain, root, pixels, room, out)


@nb.njit(cache=True, fastmath=FAST, nogil=True)
def fit_part(part, parts, image, usable, spots, which, noise, sharpening, plain, tables, out):  # noqa: PLR0917
    """Every row of `which`, from `part` on in steps of `parts`, of `spots` fitted anew, into the same row of `out`.

    `noise`: offset, slope, and the log intensity at which pixels are clipped; `sharpening`: taps, gain, change of the
    squared blur, squared blur that is left, correlation after it; `plain`: the same of leaving the image alone. Where a
    fit leaves too much, metal about the bead is looked for, hidden, and the fit repeated.
    """
    answer = np.empty(spots.shape[1])
    for i in range(part, len(which), parts):
        row = which[i]
        reach = spots[row, RADIUS] + BEYOND
        rows = _group(spots, row, reach)
        half = int(reach) + 1
        left, top = int(spots[row, U] + 0.5) - half, int(spots[row, V] + 0.5) - half
        zero = level(image, usable, spots[row], reach)
        light = look(image, left, top, half, zero)
        state = mark(image, usable, spots, rows, left, top, 2 * half + 1, noise[2])
        window = left, top, reach, zero
        for again in range(2):
            _copy(spots[row], answer)
            _solve(spots, rows, noise, sharpening, plain, tables, light, state, window, answer)
            better = answer[STATUS] == FITTED and (out[i, STATUS] != FITTED or answer[EXCESS] < out[i, EXCESS])
            if better or not again:
                _copy(answer, out[i])
            if again or (answer[STATUS] == FITTED and answer[EXCESS] <= _UNEXPLAINED) or spots[row, CONTRAST] > 0:
                break
            metal = hide_metal(state, spots, rows, left, top, light)
            if not metal or rim_seen(state, spots, rows, left, top) <= _LEAST_RIM:
                break


@exact
def _start(spots, rows, blur2):
    """Beads of a joint fit, from where the first one is thought to be; scatter; background."""
    one = spots[rows[0]]
    beads = np.zeros((len(rows), BEAD))
    for k in range(len(rows)):
        bead = spots[rows[k]]
        beads[k, 0], beads[k, 1], beads[k, 2] = bead[U] - one[U], bead[V] - one[V], bead[RADIUS]
        beads[k, 3] = np.sqrt(max(bead[BLUR] ** 2 + blur2, 0.4**2))
    scatter, ground = np.zeros(SCATTER), np.zeros(GROUND)
    ground[0] = 1.0
    scatter[0] = np.exp(one[CONTRAST]) - (1.0 - TAKEN_BY_BALL if one[CONTRAST] < 0 else 1.0)
    return beads, scatter, ground


@exact
def _roots(lift, slope):
    """One over the noise's deviation at light 0 ... 2, in steps that weights need not be finer than."""
    roots = np.empty(2 * _LIGHTS, np.float32)
    for k in range(len(roots)):
        roots[k] = ((k + 0.5) / _LIGHTS) ** (0.5 * slope - 1.0) / lift
    return roots


@part_of_caller
def _weigh(light, counting, brightest, roots, root):
    """One over the noise's deviation at the model's light, of the first `counting` pixels; how many of them count.

    Pixels that the model makes brighter than `brightest` may be clipped and do not count. The model chooses, not what
    is seen there: of pixels that are just not clipped the noise is negative.
    """
    count, zero, steps, last = np.int32(0), np.float32(0.0), np.float32(_LIGHTS), np.float32(2 * _LIGHTS - 1)
    for p in range(len(root)):
        at = np.uint32(np.int32(min(max(light[p] * steps, zero), last)))
        root[p] = roots[at] if light[p] < brightest else zero
    for p in range(counting, len(root)):
        root[p] = zero
    for p in range(len(root)):
        count += np.int32(1) if root[p] > zero else np.int32(0)
    return count


@exact
def _rely_on_what_is_known(beads, first, scatter, ground, known, A, b):  # noqa: PLR0917
    """Ellipticity and cubic terms are small, beads are about where they start, scatter slopes at most about as the
    background does; `known`: 1 / s.d.². Return how far scatter's slopes are held to the background's."""
    known[:] = 0.0
    for k in range(len(beads)):
        for m in range(4, BEAD):
            known[BEAD * k + m] = 1.0 / _ELLIPTIC**2
            b[BEAD * k + m] -= beads[k, m] / _ELLIPTIC**2
        for m in range(4):
            sd = (_NEIGHBOUR[m] if k > 0 else _ITSELF[m]) * (abs(first[k, m]) if m > 1 else 1.0)
            known[BEAD * k + m] = 1.0 / sd**2
            b[BEAD * k + m] += (first[k, m] - beads[k, m]) / sd**2
    at, to, slope = BEAD * len(beads) + 1, len(b) - GROUND + 1, np.hypot(ground[1], ground[2])
    share = scatter[0] * min(1.0, _STEEPEST / max(slope, 1e-9))
    follows, sd2 = _FOLLOWS * share, (_FOLLOWS_SD * share * slope) ** 2 + (_UNLIKE * scatter[0]) ** 2 + 1e-6
    for m in range(SCATTER - 1):
        off = (follows * ground[1 + m] - scatter[1 + m]) / sd2
        known[at + m] = 1.0 / sd2
        b[at + m] += off
        b[to + m] -= follows * off
        A[to + m, at + m] -= follows / sd2
        A[to + m, to + m] += follows**2 / sd2
    for m in range(GROUND - CUBIC):
        known[len(b) - GROUND + m] = 1.0 / _VAGUE[m] ** 2
        b[len(b) - GROUND + m] -= (ground[m] - (1.0 if m == 0 else 0.0)) / _VAGUE[m] ** 2
    for m in range(GROUND - CUBIC, GROUND):
        # Without them bone edges shift the centre; free ones cost a third of the accuracy.
        known[len(b) - GROUND + m] = 1.0 / _CUBIC**2
        b[len(b) - GROUND + m] -= ground[m] / _CUBIC**2
    for k in range(len(b)):
        A[k, k] = (A[k, k] + known[k]) * (1.0 + 1e-5)
    return follows


@exact
def _move(beads, scatter, ground, step, share):
    """Take a `share` of a step, shortened where it is wild; the largest move of the first bead's centre and radius, px,
    and of scatter, share of the light."""
    for k in range(len(step)):
        step[k] *= share
    for k in range(len(beads)):
        at = BEAD * k
        radius, blur = beads[k, 2], beads[k, 3]
        for m in range(2):
            beads[k, m] += min(max(step[at + m], -1.0), 1.0)
        beads[k, 2] += min(max(step[at + 2], -0.15 * radius), 0.15 * radius)
        beads[k, 3] = min(max(blur + step[at + 3], _LEAST_BLUR, 0.6 * blur), 1.6 * blur, beads[k, 2])
        for m in range(4, BEAD):
            beads[k, m] = min(max(beads[k, m] + step[at + m], -0.3), 0.3)
    at = BEAD * len(beads)
    for m in range(SCATTER):
        scatter[m] += min(max(step[at + m], -0.5), 0.5)
    for m in range(GROUND):
        ground[m] += step[at + SCATTER + m]
    return max(abs(step[0]), abs(step[1]), abs(step[2]), abs(step[at]))


@exact
def _absorbed(columns, where, L, wide, after):
    """Expected sum of squares that the fit takes from the residuals of noise of the correlation `after`.

    tr(H C), H = J A^-1 J' the projection on the parameters. Where noise is white this is their number.
    """
    size, pixels = len(L), columns.shape[1]
    reach = np.uint32(len(after) - 1)
    width = np.uint32(wide) + 2 * reach
    rows, at = np.empty((size, pixels), np.float32), np.empty(pixels, np.uint32)
    for p in range(pixels):
        at[p] = (where[0, p] + reach) * width + where[1, p] + reach
    field = np.zeros(width * width, np.float32)
    inner, products = field[reach * width + reach : (reach + wide) * width], np.zeros(width * wide, np.float32)
    for k in range(size):  # rows of L^-1 J'
        row = rows[k]
        _copy(columns[k], row)
        for m in range(k):
            share, other = np.float32(L[k, m]), rows[m]
            for p in range(pixels):
                row[p] -= share * other[p]
        scale = np.float32(1.0 / L[k, k])
        for p in range(pixels):
            row[p] *= scale
            field[at[p]] = row[p]
        noise = in_one_row(field, after, width)
        for p in range(len(inner)):
            products[p] += inner[p] * noise[p]
    return products.sum()


@exact
def _covariance(columns, where, L, wide, after, scale2, known, follows, ground, out):  # noqa: PLR0917
    """What noise of the correlation `after`, and what was relied on, do to u, v and the light in the middle.

    Expects the blur in `out`.
    """
    size = len(L)
    unit, influence = np.zeros(size), np.empty((3, size))
    for row, parameter in enumerate((0, 1, size - GROUND - SCATTER)):
        unit[:] = 0.0
        unit[parameter] = 1.0
        substitute(L, unit, influence[row])
    reach = np.uint32(len(after) - 1)
    width, pixels = np.uint32(wide) + 2 * reach, columns.shape[1]
    total, field = np.zeros((3, pixels), np.float32), np.zeros((3, width * width), np.float32)
    for k in range(size):
        u, v, contrast = np.float32(influence[0, k]), np.float32(influence[1, k]), np.float32(influence[2, k])
        column = columns[k]
        for p in range(pixels):
            total[0, p] += u * column[p]
            total[1, p] += v * column[p]
            total[2, p] += contrast * column[p]
    for p in range(pixels):
        at = (where[0, p] + reach) * width + where[1, p] + reach
        field[0, at], field[1, at], field[2, at] = total[0, p], total[1, p], total[2, p]
    noise = in_one_row(field.reshape(-1), after, width)
    across, along, middle = noise[: width * wide], noise[width * width :], noise[2 * width * width :]
    inner = field[:, reach * width + reach : (reach + wide) * width]
    out[CUU] = scale2 * _product(inner[0], across)
    out[CUV] = scale2 * _product(inner[1], across)
    out[CVV] = scale2 * _product(inner[1], along)
    out[CCC] = scale2 * _product(inner[2], middle)
    for m in range(SCATTER - 1):
        for row in range(2):
            influence[row, size - GROUND - SCATTER + 1 + m] -= follows * influence[row, size - GROUND + 1 + m]
    for k in range(size):
        # Of cubic terms as much is taken to be missing as the fit found.
        m = k - (size - GROUND)
        missing = known[k] ** 2 * (ground[m] ** 2 + _FLAT**2) if m >= GROUND - CUBIC else known[k]
        out[CUU] += influence[0, k] ** 2 * missing
        out[CUV] += influence[0, k] * influence[1, k] * missing
        out[CVV] += influence[1, k] ** 2 * missing
    bent = 1.0 + _RIM_BENDS * 0.5 * (out[CUU] + out[CVV]) / max(out[BLUR], _LEAST_BLUR) ** 2
    out[CUU], out[CUV], out[CVV] = bent * out[CUU], bent * out[CUV], bent * out[CVV]


@exact
def _product(field, correlated):
    """Sum of the products of a field and what noise makes of another."""
    total = np.float32(0.0)
    for p in range(len(field)):
        total += field[p] * correlated[p]
    return total


@exact_unchecked
def _judge(table, at, where, light, beads, scatter, ground, optics, blurs, gain, root, pixels, room, out):  # noqa: PLR0917
    """How well the bead explains its window as it was before sharpening: residual, weakest sector."""
    for k in range(len(beads)):
        beads[k, 3] = np.sqrt(max(beads[k, 3] ** 2 - blurs[0], _LEAST_BLUR**2))
    optics = optics[0], optics[1], np.float32(blurs[1] - blurs[0])
    margin, darkest, zero = np.uint32(MARGIN), np.float32(0.02), np.float32(0.0)
    for p in range(at.shape[1]):
        at[2, p] = light[where[0, p] + margin, where[1, p] + margin]
    behind, effect, columns = room
    fill_light(table, at, beads, scatter, ground, optics, behind, effect, columns)
    rest, meant_light, bright = columns[-3], columns[-2], columns[-1]
    residuals = expected = zero
    for p in range(at.shape[1]):
        m, counts = max(meant_light[p], darkest), root[p] > zero
        residual, sd = rest[p] / m, np.float32(1.0) / (root[p] * m)
        residuals += residual * residual if counts else zero
        expected += sd * sd if counts else zero
    beyond = max(residuals - _SPREAD_OF_NOISE * expected / gain, 0.0) / pixels
    out[EXCESS] = np.sqrt(beyond) / max(abs(out[CONTRAST]), 1e-9)
    seen, meant, rim2 = np.zeros(8), np.zeros(8), (beads[0, 2] + 1) ** 2
    for p in range(at.shape[1]):
        x, y = at[0, p] - beads[0, 0], at[1, p] - beads[0, 1]
        if x * x + y * y < rim2 and root[p] > 0:
            bead = max(meant_light[p], darkest) / bright[p] - np.float32(1.0)
            sector = 4 * (x > 0) + 2 * (y > 0) + (abs(x) > abs(y))
            seen[sector] += (rest[p] / bright[p] + bead) * bead
            meant[sector] += bead * bead
    whole = 0.0
    for k in range(8):
        whole += meant[k]
    out[WEAKEST] = 1.0
    for k in range(8):
        if meant[k] > whole / 32:  # a sector that a neighbour covers says nothing
            out[WEAKEST] = min(out[WEAKEST], seen[k] / meant[k])
