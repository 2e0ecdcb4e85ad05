"""The window of a bead: its light, the state of each pixel, and the separable filter."""

import numpy as np

from sightline.detection.beads.columns import CONTRAST, RADIUS, U, V
from sightline.detection.beads.noise import LAGS
from sightline.kernels import exact, fast, part_of_caller, squared

BEYOND = 5.0  # px of background around the rim, enough for five blurs [ours]
TAPS = 6  # px to either side, of the filter
MARGIN = TAPS  # px around the window that the filter may need
_FILTER_REACH = 3  # px to which the filter carries an unusable pixel
# Metal is darker than this, as a share of the step from the bead's light to the background's; dense bone reaches 0.4
# [twin].
_METAL_SHARE = 0.3
METAL = 4  # px around metal: its rim and the blur of that
_MIN_METAL = 6  # px [ours]
_RIM = 2.5  # px to either side of the rim, the zone that determines a centre
VECTOR = 32  # SIMD width; a scalar tail loop doubles the time
# States of a pixel, the most usable first: visible, but within the filter's reach of an unusable one (set by
# `mark_near_unusable`); clipped; hidden, or outside the field.
SEEN, NEAR_UNUSABLE, CLIPPED, HIDDEN = range(4)


def window_reach(radius_px: np.ndarray) -> np.ndarray:
    """Return the whole px (N,) to either side of a bead's nearest pixel that its fit may read."""
    return (radius_px + BEYOND).astype(int) + 1 + MARGIN


@fast
def log_level(image, usable, bead, reach):
    """Return the mean log light around the bead; 0 where no pixel there is usable."""
    height, width = image.shape
    total, outside, zero = np.float32(0.0), 0, np.float32(0.0)
    inner2, outer2 = np.float32(squared(bead[RADIUS] + 1.5)), np.float32(squared(reach))
    u, left = np.float32(bead[U]), max(int(bead[U] - reach), 0)
    for i in range(max(int(bead[V] - reach), 0), min(int(bead[V] + reach) + 2, height), 2):  # half of them are enough
        dv2 = np.float32(squared(i - bead[V]))
        values, known = image[i, left:], usable[i, left:]
        count = np.int32(0)
        for j in range(min(int(bead[U] + reach) + 2, width) - left):  # without branches, so that it is vectorised
            du = np.float32(j + left) - u
            r2 = du * du + dv2
            counts = (r2 > inner2) & (r2 < outer2) & known[j]
            total += values[j] if counts else zero
            count += np.int32(counts)
        outside += count
    return total / max(outside, 1)


@exact
def window_light(image, left, top, half, zero):
    """Return the light exp(image - zero) of the window and MARGIN pixels around it; the image's border is repeated."""
    height, width = image.shape
    n = 2 * (half + MARGIN) + 1
    light = np.empty((n, n), np.float32)
    first, last = min(max(MARGIN - left, 0), n), max(min(width + MARGIN - left, n), 0)  # of a row, inside the image
    level = np.float32(zero)
    for i in range(n):
        seen, row = image[min(max(top + i - MARGIN, 0), height - 1)], light[i]
        inside, within = seen[max(left - MARGIN, 0) :], row[first:last]
        for j in range(len(within)):
            within[j] = inside[j] - level
        for j in range(first):
            row[j] = seen[0] - np.float32(zero)
        for j in range(last, n):
            row[j] = seen[width - 1] - np.float32(zero)
    _exponentiate(light.reshape(-1))
    return light


@part_of_caller
def _exponentiate(values):
    """Replace values, limited to ±8, by their exponentials, to 1e-6.

    A polynomial of x / 16, squared four times: the compiler vectorises it, unlike np.exp.
    """
    one = np.float32(1.0)
    for k in range(len(values)):
        x = min(max(values[k], np.float32(-8.0)), np.float32(8.0)) * np.float32(1 / 16)
        y = one + x * np.float32(1 / 6) * (one + x * np.float32(1 / 7))
        y = one + x * np.float32(1 / 4) * (one + x * np.float32(1 / 5) * y)
        y = one + x * (one + x * np.float32(1 / 2) * (one + x * np.float32(1 / 3) * y))
        y *= y
        y *= y
        y *= y
        values[k] = y * y


@exact
def pixel_states(image, usable, spots, rows, left, top, n, ceiling):  # noqa: PLR0917
    """Return the state (n, n) of each pixel; hidden ones lie outside the field or on another spot."""
    height, width = usable.shape
    state = np.zeros((n, n), np.uint8)
    first, last = min(max(-left, 0), n), max(min(width - left, n), 0)  # of a row, inside the image
    hidden, clipped, seen = np.uint8(HIDDEN), np.uint8(CLIPPED), np.uint8(SEEN)
    for i in range(n):
        if not 0 <= top + i < height:
            state[i] = hidden
            continue
        state[i, :first], state[i, last:] = hidden, hidden
        known, values, row = usable[top + i, max(left, 0) :], image[top + i, max(left, 0) :], state[i, first:last]
        for j in range(len(row)):  # without branches, so that it is vectorised
            row[j] = (clipped if values[j] >= ceiling else seen) if known[j] else hidden
    one = spots[rows[0]]
    for k in range(len(spots)):
        x, y, reach = spots[k, U] - left, spots[k, V] - top, spots[k, RADIUS] + 2.5
        if x + reach < 0 or y + reach < 0 or x - reach > n or y - reach > n:
            continue
        if abs(spots[k, CONTRAST]) < 0.5 * abs(one[CONTRAST]):
            continue
        mine = np.hypot(spots[k, U] - one[U], spots[k, V] - one[V]) < spots[k, RADIUS] - 0.5 * one[RADIUS]
        for row in rows:
            apart = np.hypot(spots[k, U] - spots[row, U], spots[k, V] - spots[row, V])
            mine |= apart < 0.8 * max(spots[row, RADIUS], spots[k, RADIUS])
        if not mine:
            _hide(state, y, x, reach)
    return state


@exact
def _hide(state, y, x, reach):
    n = len(state)
    for i in range(max(0, int(y - reach)), min(n, int(y + reach) + 2)):
        for j in range(max(0, int(x - reach)), min(n, int(x + reach) + 2)):
            if (i - y) ** 2 + (j - x) ** 2 < reach * reach:
                state[i, j] = HIDDEN


@exact
def hide_metal(state, spots, rows, left, top, light) -> bool:  # noqa: PLR0917
    """Hide pixels around the beads that are nearly as dark as the first bead; return whether there are any."""
    n = len(state)
    mean, free, dark = _about_beads(state, spots, rows, left, top, light)
    limit, found = _metal_limit(mean, free, dark), 0
    for i in range(n):
        for j in range(n):
            free[i, j] &= mean[i, j] < limit
            found += free[i, j]
    if found < _MIN_METAL:
        return False
    for i in range(n):
        for j in range(n):
            if free[i, j]:
                _hide(state, float(i), float(j), METAL + 0.5)
    return True


@part_of_caller
def _about_beads(state, spots, rows, left, top, light):  # noqa: PLR0917
    """Return means over 3x3 pixels, whether each is free of beads, and the first bead's light in its middle."""
    n = len(state)
    mean, free = np.zeros((n, n), np.float32), np.zeros((n, n), np.bool_)
    inside, core = 0.0, 0
    for i in range(n):
        for j in range(n):
            if state[i, j] == HIDDEN:
                continue
            for y in range(i + MARGIN - 1, i + MARGIN + 2):
                for x in range(j + MARGIN - 1, j + MARGIN + 2):
                    mean[i, j] += light[y, x] / np.float32(9)
            free[i, j] = True
            for k in range(len(rows)):
                r2 = squared(left + j - spots[rows[k], U]) + squared(top + i - spots[rows[k], V])
                free[i, j] &= r2 > squared(spots[rows[k], RADIUS] + 2.0)
                if k == 0 and r2 < squared(0.5 * spots[rows[0], RADIUS]):
                    inside += mean[i, j]
                    core += 1
    return mean, free, inside / max(core, 1)


@exact
def _metal_limit(mean, free, dark):
    """Return the light below which a pixel is metal, between the bead's light and that of the metal-free background."""
    limit = 0.0
    for _ in range(4):
        bright, count = 0.0, 0
        for i in range(len(mean)):
            for j in range(len(mean)):
                if free[i, j] and mean[i, j] > limit:
                    bright += mean[i, j]
                    count += 1
        limit = dark + _METAL_SHARE * (bright / max(count, 1) - dark)
    return limit


@exact
def visible_rim(state, spots, rows, left, top):
    """Return the share of the first bead's rim that is neither hidden nor on another bead."""
    rim, seen = 0, 0
    for i in range(len(state)):
        for j in range(len(state)):
            x, y = left + j, top + i
            if abs(np.hypot(x - spots[rows[0], U], y - spots[rows[0], V]) - spots[rows[0], RADIUS]) < _RIM:
                rim += 1
                free = state[i, j] != HIDDEN
                for k in range(1, len(rows)):
                    free &= np.hypot(x - spots[rows[k], U], y - spots[rows[k], V]) > spots[rows[k], RADIUS]
                seen += free
    return seen / max(rim, 1)


@part_of_caller
def mark_near_unusable(state, x, y, radius):
    """Mark visible pixels within the filter's reach of unusable ones; return the share of the visible rim lost."""
    n, reach = len(state), _FILTER_REACH
    clipped, near, one = np.uint8(CLIPPED), np.uint8(NEAR_UNUSABLE), np.uint8(1)
    wide, any_unusable = np.zeros((n + 2 * reach) * (n + 2 * reach), np.uint8), np.uint8(0)  # rows, one after another
    for i in range(n):
        seen, row = state[i], wide[(i + reach) * (n + 2 * reach) + reach :]
        for j in range(n):
            row[j] = one if seen[j] >= clipped else np.uint8(0)
            any_unusable |= row[j]
    if not any_unusable:
        return 0.0
    _spread(wide, 1)
    _spread(wide, n + 2 * reach)
    inner2, outer2 = np.float32(squared(max(radius - _RIM, 0.0))), np.float32(squared(radius + _RIM))
    rim, lost = 0, 0
    for i in range(n):
        seen, reached, dy2 = state[i], wide[i * (n + 2 * reach) :], np.float32(squared(i - y))
        of_row, lost_in_row = np.int32(0), np.int32(0)
        for j in range(n):
            seen[j] = max(seen[j], near if reached[j] else np.uint8(0))
            dx = np.float32(j) - np.float32(x)
            r2 = dx * dx + dy2
            on_rim = (r2 > inner2) & (r2 < outer2) & (seen[j] != np.uint8(HIDDEN))
            of_row += np.int32(on_rim)
            lost_in_row += np.int32(on_rim & (seen[j] != np.uint8(SEEN)))
        rim += of_row
        lost += lost_in_row
    return lost / max(rim, 1)


@exact
def _spread(marks, step):
    """Combine each mark with the 2 _FILTER_REACH = 6 marks, `step` apart, that follow it."""
    for shift in (step, 2 * step, 3 * step):  # of 2, 4 and 7 marks: three passes where 7 single ones cost more
        later = marks[shift:]
        for k in range(len(later)):
            marks[k] |= later[k]


@part_of_caller
def gather_pixels(state, filtered, values, x0, y0, reach):  # noqa: PLR0917
    """Return the counting pixels' x, y from (`x0`, `y0`) and values (3, N), rows and columns (2, N), and their number.

    Clipped pixels never count; where the values are filtered, nor do those that an unusable one reaches. N is padded to
    a multiple of VECTOR with pixels at (0, 0).
    """
    n = len(state)
    margin = (len(values) - n) // 2
    capacity = n * n + VECTOR
    at, where = np.empty((3, capacity), np.float32), np.empty((2, capacity), np.uint32)
    worst, reach2 = np.uint8(SEEN if filtered else NEAR_UNUSABLE), np.float32(reach * reach)
    pixels = np.uint32(0)
    for i in range(n):
        y, row, seen = np.float32(i - y0), state[i], values[i + margin, margin:]
        for j in range(n):
            x = np.float32(j) - np.float32(x0)
            at[0, pixels], at[1, pixels], at[2, pixels] = x, y, seen[j]
            where[0, pixels], where[1, pixels] = np.uint32(i), np.uint32(j)
            counts = (x * x + y * y < reach2) & (row[j] <= worst)
            pixels += np.uint32(counts)  # branch-free: a pixel that does not count is overwritten
    count = int(pixels)
    whole = (count + VECTOR - 1) // VECTOR * VECTOR
    at[:, count:whole], where[:, count:whole] = 0.0, 0
    return at[:, :whole].copy(), where[:, :whole].copy(), count


@fast
def along_both_axes(field, taps):
    """Return `field` convolved along both axes with the symmetric `taps` (TAPS + 1,), cropped by TAPS on each side."""
    t, width = TAPS, field.shape[1]
    values = field.reshape(-1)
    size = len(values) - 2 * t * width
    once, twice = np.empty(size, np.float32), np.empty(size, np.float32)
    _along(values, taps, width, once)
    _along(once, taps, 1, twice[: size - 2 * t])
    twice[size - 2 * t :] = 0.0
    return twice.reshape(size // width, width)[:, : width - 2 * t]


@fast
def correlated_products(fields, correlation, width):
    """Return the sums of products uu, uv, vv and ww of `fields` u, v and w, through a noise `correlation`.

    The second factor is convolved with the correlation along both axes. `fields` (3, N): flattened, with rows of
    `width` and LAGS of zeros on each side. The correlation is symmetric, so one factor is convolved along the rows and
    the other along the columns.
    """
    c = np.zeros(LAGS + 1, np.float32)
    for k in range(len(correlation)):
        c[k] = correlation[k]
    at = LAGS * width
    rows = np.empty((len(fields), fields.shape[1] - 2 * at), np.float32)
    columns = np.empty((len(fields), fields.shape[1] - 2 * at), np.float32)
    for k in range(len(fields)):
        _correlated(fields[k, at - LAGS :], c, 1, rows[k])
        _correlated(fields[k], c, width, columns[k])
    uu = uv = vv = ww = np.float32(0.0)
    u, v, w, du, dv, dw = rows[0], rows[1], rows[2], columns[0], columns[1], columns[2]
    for p in range(len(u)):
        uu, uv, vv, ww = uu + u[p] * du[p], uv + u[p] * dv[p], vv + v[p] * dv[p], ww + w[p] * dw[p]
    return uu, uv, vv, ww


@fast
def _correlated(values, c, step, out):
    """Convolve `values` with the correlation `c` (LAGS + 1,) at places that are `step` apart."""
    c0, c1, c2, c3, c4 = c[0], c[1], c[2], c[3], c[4]
    x0, x1, x2, x3, x4 = values[4 * step :], values[3 * step :], values[2 * step :], values[step:], values
    y1, y2, y3, y4 = values[5 * step :], values[6 * step :], values[7 * step :], values[8 * step :]
    for p in range(len(out)):
        near = c0 * x0[p] + c1 * (x1[p] + y1[p]) + c2 * (x2[p] + y2[p])
        out[p] = near + c3 * (x3[p] + y3[p]) + c4 * (x4[p] + y4[p])


@fast
def _along(values, taps, step, out):
    """Convolve `values` with `taps` that are `step` apart, in one loop that the compiler vectorises."""
    t0, t1, t2, t3, t4, t5, t6 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5], taps[6]
    x0, x1, x2, x3 = values[6 * step :], values[5 * step :], values[4 * step :], values[3 * step :]
    x4, x5, x6 = values[2 * step :], values[step:], values
    y1, y2, y3 = values[7 * step :], values[8 * step :], values[9 * step :]
    y4, y5, y6 = values[10 * step :], values[11 * step :], values[12 * step :]
    for p in range(len(out)):
        near = t0 * x0[p] + t1 * (x1[p] + y1[p]) + t2 * (x2[p] + y2[p]) + t3 * (x3[p] + y3[p])
        out[p] = near + t4 * (x4[p] + y4[p]) + t5 * (x5[p] + y5[p]) + t6 * (x6[p] + y6[p])
