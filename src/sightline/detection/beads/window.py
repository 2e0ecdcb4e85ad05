"""The window of a bead: its light, the state of each pixel, and the separable filter."""

import numpy as np

from sightline.common.kernels import kernel
from sightline.detection.beads.noise import LAGS

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


@kernel()
def log_level(image, usable, u, v, radius, reach):  # noqa: PLR0917 - a kernel
    """Return the mean log light around the bead; 0 where no pixel there is usable."""
    height, width = image.shape
    total, outside = 0.0, 0
    inner2, outer2 = np.float32((radius + 1.5) ** 2), np.float32(reach**2)
    left, right = max(int(u - reach), 0), min(int(u + reach) + 2, width)
    for i in range(max(int(v - reach), 0), min(int(v + reach) + 2, height), 2):  # half of them are enough
        dv2 = np.float32((i - v) ** 2)
        for j in range(left, right):
            du = np.float32(j) - np.float32(u)
            r2 = du * du + dv2
            if inner2 < r2 < outer2 and usable[i, j]:
                total += image[i, j]
                outside += 1
    return total / max(outside, 1)


@kernel()
def window_light(image, left, top, half, zero):
    """Return the light exp(image - zero) of the window and MARGIN pixels around it; the image's border is repeated.

    It is limited to exp(±8).
    """
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
            row[j] = seen[0] - level
        for j in range(last, n):
            row[j] = seen[width - 1] - level
    # The exponential, to 1e-6: a polynomial of x / 16, squared four times. The compiler vectorises it, unlike np.exp.
    unity, values = np.float32(1.0), light.reshape(-1)
    for k in range(len(values)):
        x = min(max(values[k], np.float32(-8.0)), np.float32(8.0)) * np.float32(1 / 16)
        y = unity + x * np.float32(1 / 6) * (unity + x * np.float32(1 / 7))
        y = unity + x * np.float32(1 / 4) * (unity + x * np.float32(1 / 5) * y)
        y = unity + x * (unity + x * np.float32(1 / 2) * (unity + x * np.float32(1 / 3) * y))
        y *= y
        y *= y
        y *= y
        values[k] = y * y
    return light


@kernel()
def pixel_states(image, usable, spots, rows, left, top, n, ceiling):  # noqa: PLR0917 - a kernel
    """Return the state (n, n) of each pixel; hidden ones lie outside the field or on another spot."""
    height, width = usable.shape
    state = np.full((n, n), np.uint8(HIDDEN))
    first, last = min(max(-left, 0), n), max(min(width - left, n), 0)  # of a row, inside the image
    hidden, clipped, seen = np.uint8(HIDDEN), np.uint8(CLIPPED), np.uint8(SEEN)
    for i in range(max(-top, 0), min(height - top, n)):
        known, values, row = usable[top + i, max(left, 0) :], image[top + i, max(left, 0) :], state[i, first:last]
        for j in range(len(row)):  # without branches, so that it is vectorised
            row[j] = (clipped if values[j] >= ceiling else seen) if known[j] else hidden
    own = spots[rows[0]]
    for k in range(len(spots)):
        other = spots[k]
        x, y, reach = other.u_px - left, other.v_px - top, other.radius_px + 2.5
        if x + reach < 0 or y + reach < 0 or x - reach > n or y - reach > n:
            continue
        if abs(other.contrast) < 0.5 * abs(own.contrast):
            continue
        mine = np.hypot(other.u_px - own.u_px, other.v_px - own.v_px) < other.radius_px - 0.5 * own.radius_px
        for row in rows:
            bead = spots[row]
            apart = np.hypot(other.u_px - bead.u_px, other.v_px - bead.v_px)
            mine |= apart < 0.8 * max(bead.radius_px, other.radius_px)
        if not mine:
            _hide(state, y, x, reach)
    return state


@kernel()
def _hide(state, y, x, reach):
    n = len(state)
    for i in range(max(0, int(y - reach)), min(n, int(y + reach) + 2)):
        for j in range(max(0, int(x - reach)), min(n, int(x + reach) + 2)):
            if (i - y) ** 2 + (j - x) ** 2 < reach * reach:
                state[i, j] = HIDDEN


@kernel()
def hide_metal(state, spots, rows, left, top, light) -> bool:  # noqa: PLR0912, PLR0917 - a kernel
    """Hide pixels around the beads that are nearly as dark as the first bead; return whether there are any."""
    n = len(state)
    mean, free = np.zeros((n, n), np.float32), np.zeros((n, n), np.bool_)  # over 3x3 pixels; free of beads
    inside, core = 0.0, 0  # light in the first bead's middle
    for i in range(n):
        for j in range(n):
            if state[i, j] == HIDDEN:
                continue
            for y in range(i + MARGIN - 1, i + MARGIN + 2):
                for x in range(j + MARGIN - 1, j + MARGIN + 2):
                    mean[i, j] += light[y, x] / np.float32(9)
            free[i, j] = True
            for k in range(len(rows)):
                bead = spots[rows[k]]
                r2 = (left + j - bead.u_px) ** 2 + (top + i - bead.v_px) ** 2
                free[i, j] &= r2 > (bead.radius_px + 2.0) ** 2
                if k == 0 and r2 < (0.5 * bead.radius_px) ** 2:
                    inside += mean[i, j]
                    core += 1
    dark, limit = inside / max(core, 1), 0.0
    for _ in range(4):  # the light below which a pixel is metal, from the mean of the metal-free background
        bright, count = 0.0, 0
        for i in range(n):
            for j in range(n):
                if free[i, j] and mean[i, j] > limit:
                    bright += mean[i, j]
                    count += 1
        limit = dark + _METAL_SHARE * (bright / max(count, 1) - dark)
    count = 0
    for i in range(n):
        for j in range(n):
            free[i, j] &= mean[i, j] < limit
            count += free[i, j]
    if count < _MIN_METAL:
        return False
    for i in range(n):
        for j in range(n):
            if free[i, j]:
                _hide(state, float(i), float(j), METAL + 0.5)
    return True


@kernel()
def visible_rim(state, spots, rows, left, top):
    """Return the share of the first bead's rim that is neither hidden nor on another bead."""
    rim, seen, own = 0, 0, spots[rows[0]]
    for i in range(len(state)):
        for j in range(len(state)):
            x, y = left + j, top + i
            if abs(np.hypot(x - own.u_px, y - own.v_px) - own.radius_px) < _RIM:
                rim += 1
                free = state[i, j] != HIDDEN
                for k in range(1, len(rows)):
                    other = spots[rows[k]]
                    free &= np.hypot(x - other.u_px, y - other.v_px) > other.radius_px
                seen += free
    return seen / max(rim, 1)


@kernel()
def mark_near_unusable(state, x, y, radius):
    """Mark visible pixels within the filter's reach of unusable ones; return the share of the visible rim lost."""
    n, reach = len(state), _FILTER_REACH
    side = n + 2 * reach
    clipped, near, mark = np.uint8(CLIPPED), np.uint8(NEAR_UNUSABLE), np.uint8(1)
    wide, any_unusable = np.zeros(side * side, np.uint8), np.uint8(0)  # rows, one after another
    for i in range(n):
        seen, row = state[i], wide[(i + reach) * side + reach :]
        for j in range(n):
            row[j] = mark if seen[j] >= clipped else np.uint8(0)
            any_unusable |= row[j]
    if not any_unusable:
        return 0.0
    for k in range(4 * reach):  # along the rows and then the columns: each mark takes the following ones
        later = wide[1 if k < 2 * reach else side :]
        for p in range(len(later)):
            wide[p] |= later[p]
    inner2, outer2 = np.float32(max(radius - _RIM, 0.0) ** 2), np.float32((radius + _RIM) ** 2)
    rim, lost = 0, 0
    for i in range(n):
        seen, reached, dy2 = state[i], wide[i * side :], np.float32((i - y) ** 2)
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


@kernel()
def gather_pixels(state, filtered, values, x0, y0, reach):  # noqa: PLR0917 - a kernel
    """Return the counting pixels' x, y from (`x0`, `y0`) and values (3, N), rows and columns (2, N), and their number.

    Clipped pixels never count; where the values are filtered, nor do those that an unusable one reaches. N is padded to
    a multiple of VECTOR with pixels at (0, 0). `values`: of the pixels and a margin around them.
    """
    n = len(state)
    margin = (len(values) - n) // 2
    capacity = n * n + VECTOR
    x_y, values_at = np.empty((2, capacity), np.float32), np.empty(capacity, np.float32)
    row_column = np.empty((2, capacity), np.uint32)
    worst, reach2 = np.uint8(SEEN if filtered else NEAR_UNUSABLE), np.float32(reach * reach)
    pixels = np.uint32(0)
    for i in range(n):
        y, row, seen = np.float32(i - y0), state[i], values[i + margin, margin:]
        for j in range(n):
            x = np.float32(j) - np.float32(x0)
            x_y[0, pixels], x_y[1, pixels], values_at[pixels] = x, y, seen[j]
            row_column[0, pixels], row_column[1, pixels] = np.uint32(i), np.uint32(j)
            counts = (x * x + y * y < reach2) & (row[j] <= worst)
            pixels += np.uint32(counts)  # branch-free: a pixel that does not count is overwritten
    count = int(pixels)
    padded = (count + VECTOR - 1) // VECTOR * VECTOR
    at, where = np.zeros((3, padded), np.float32), np.zeros((2, padded), np.uint32)
    for k in range(count):
        at[0, k], at[1, k], at[2, k] = x_y[0, k], x_y[1, k], values_at[k]
        where[0, k], where[1, k] = row_column[0, k], row_column[1, k]
    return at, where, count


@kernel()
def along_both_axes(field, taps):
    """Return a `field` (H, W) convolved along both axes with the symmetric `taps` (K + 1,): (H - 2 K, W).

    It begins K places further in; the last 2 K columns have no meaning.
    """
    reach, (height, width) = len(taps) - 1, field.shape
    size = (height - 2 * reach) * width
    rows, columns = np.empty(size, np.float32), np.empty(size, np.float32)
    convolve(field.reshape(-1), taps, width, rows)
    columns[size - 2 * reach :] = 0.0
    convolve(rows, taps, width // width, columns[: size - 2 * reach])
    return columns.reshape(height - 2 * reach, width)


@kernel()
def correlated_products(fields, correlation, width):
    """Return the sums of products uu, uv, vv and ww of `fields` u, v and w, through a noise `correlation`.

    The second factor is convolved with the correlation along both axes. `fields` (3, N): flattened, with rows of
    `width` and LAGS of zeros on each side. The correlation is symmetric, so one factor is convolved along the rows and
    the other along the columns.
    """
    at, reach = LAGS * width, len(correlation) - 1
    size = fields.shape[1] - 2 * at
    along_rows, along_columns = np.empty((3, size), np.float32), np.empty((3, size), np.float32)
    for k in range(3):
        convolve(fields[k, at - reach : at + size + reach], correlation, width // width, along_rows[k])
        convolve(fields[k, at - reach * width :], correlation, width, along_columns[k])
    uu = uv = vv = ww = 0.0
    for p in range(size):
        u, v, w = along_rows[0, p], along_rows[1, p], along_rows[2, p]
        du, dv, dw = along_columns[0, p], along_columns[1, p], along_columns[2, p]
        uu, uv, vv, ww = uu + u * du, uv + u * dv, vv + v * dv, ww + w * dw
    return uu, uv, vv, ww


@kernel()
def convolve(values, taps, step, result):
    """Fill `result` with the convolution of `values` with symmetric `taps` (K + 1,), which are `step` places apart.

    The first of `result` is at K steps in `values`. The compiler vectorises each of the inner loops.
    """
    last = len(taps) - 1
    middle = values[last * step :]
    for p in range(len(result)):
        result[p] = taps[0] * middle[p]
    for k in range(1, last + 1):
        tap, before, after = taps[k], values[(last - k) * step :], values[(last + k) * step :]
        for p in range(len(result)):
            result[p] += tap * (before[p] + after[p])
