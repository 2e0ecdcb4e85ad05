"""The window of a bead: its light, which of its pixels tell of the bead, and the filter along both axes."""

import numpy as np

from sightline.detection.columns import CONTRAST, RADIUS, U, V
from sightline.detection.compiled import exact, fast, part_of_caller

BEYOND = 5.0  # px of background about the rim, and as many blurs as fit [ours]
MARGIN = 6  # px about the window that the filter may need
_SPREAD = 3  # px about a pixel that is not usable, into which the filter carries it
# Of the step from the bead's light to the background's: below it lies metal; dense bone reaches 0.4 [twin].
_AS_DARK = 0.3
METAL = 4  # px about metal: its rim and the blur of that
_FEWEST_METAL = 6  # px [ours]
_RIM = 2.5  # px to either side of the rim, where a centre is told from
_VECTOR = 32  # pixels that a loop takes at once: a remainder takes as long as all the rest
SEEN, CLIPPED, HIDDEN = 0, 1, 2


@exact
def level(image, usable, bead, reach):
    """Mean log light about the bead; 0 where nothing about it is usable."""
    height, width = image.shape
    total, outside = 0.0, 0
    inner2, outer2 = (bead[RADIUS] + 1.5) ** 2, reach**2
    for i in range(max(int(bead[V] - reach), 0), min(int(bead[V] + reach) + 2, height)):
        for j in range(max(int(bead[U] - reach), 0), min(int(bead[U] + reach) + 2, width)):
            r2 = (j - bead[U]) ** 2 + (i - bead[V]) ** 2
            if inner2 < r2 < outer2 and usable[i, j]:
                total += image[i, j]
                outside += 1
    return total / max(outside, 1)


@exact
def look(image, left, top, half, zero):
    """The light exp(image - zero) of the window and MARGIN pixels about it; the image's border repeats."""
    height, width = image.shape
    n = 2 * (half + MARGIN) + 1
    light = np.empty((n, n), np.float32)
    first, last = min(max(MARGIN - left, 0), n), max(min(width + MARGIN - left, n), 0)  # of a row, inside the image
    for i in range(n):
        seen, row = image[min(max(top + i - MARGIN, 0), height - 1)], light[i]
        inside = seen[max(left - MARGIN, 0) :]
        for j in range(first, last):
            row[j] = inside[j - first] - np.float32(zero)
        for j in range(first):
            row[j] = seen[0] - np.float32(zero)
        for j in range(last, n):
            row[j] = seen[width - 1] - np.float32(zero)
    _exponentiate(light.reshape(-1))
    return light


@part_of_caller
def _exponentiate(values):
    """exp of values, those beyond 8 in size taken for 8, to 1e-6: a polynomial of x / 16, squared four times, which is
    vectorised."""
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
def mark(image, usable, spots, rows, left, top, n, ceiling):  # noqa: PLR0917
    """(n, n) whether each pixel is seen, clipped, or hidden: outside the field, or on something else."""
    height, width = usable.shape
    state = np.zeros((n, n), np.uint8)
    for i in range(n):
        for j in range(n):
            y, x = top + i, left + j
            if not (0 <= y < height and 0 <= x < width and usable[y, x]):
                state[i, j] = HIDDEN
            elif image[y, x] >= ceiling:
                state[i, j] = CLIPPED
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
    """Hide what stands about the beads and is nearly as dark as the first one; whether there is any."""
    n = len(state)
    mean, free, dark = _about_beads(state, spots, rows, left, top, light)
    limit, found = _metal_limit(mean, free, dark), 0
    for i in range(n):
        for j in range(n):
            free[i, j] &= mean[i, j] < limit
            found += free[i, j]
    if found < _FEWEST_METAL:
        return False
    for i in range(n):
        for j in range(n):
            if free[i, j]:
                _hide(state, float(i), float(j), METAL + 0.5)
    return True


@part_of_caller
def _about_beads(state, spots, rows, left, top, light):  # noqa: PLR0917
    """Means over 3x3 pixels, which of them are on no bead, and the first bead's own light in its middle."""
    n = len(state)
    mean, free = np.zeros((n, n), np.float32), np.zeros((n, n), np.bool_)
    inside, core = 0.0, 0
    for i in range(n):
        for j in range(n):
            if state[i, j] & 3 == HIDDEN:
                continue
            for y in range(i + MARGIN - 1, i + MARGIN + 2):
                for x in range(j + MARGIN - 1, j + MARGIN + 2):
                    mean[i, j] += light[y, x] / np.float32(9)
            free[i, j] = True
            for k in range(len(rows)):
                r = np.hypot(left + j - spots[rows[k], U], top + i - spots[rows[k], V])
                free[i, j] &= r > spots[rows[k], RADIUS] + 2.0
                if k == 0 and r < 0.5 * spots[rows[0], RADIUS]:
                    inside += mean[i, j]
                    core += 1
    return mean, free, inside / max(core, 1)


@exact
def _metal_limit(mean, free, dark):
    """What is darker than this is metal: between the bead's light and that of the background, which is free of it."""
    limit = 0.0
    for _ in range(4):
        bright, count = 0.0, 0
        for i in range(len(mean)):
            for j in range(len(mean)):
                if free[i, j] and mean[i, j] > limit:
                    bright += mean[i, j]
                    count += 1
        limit = dark + _AS_DARK * (bright / max(count, 1) - dark)
    return limit


@exact
def rim_seen(state, spots, rows, left, top):
    """Share of the first bead's rim that is neither hidden nor on another bead."""
    rim, seen = 0, 0
    for i in range(len(state)):
        for j in range(len(state)):
            x, y = left + j, top + i
            if abs(np.hypot(x - spots[rows[0], U], y - spots[rows[0], V]) - spots[rows[0], RADIUS]) < _RIM:
                rim += 1
                free = state[i, j] & 3 != HIDDEN
                for k in range(1, len(rows)):
                    free &= np.hypot(x - spots[rows[k], U], y - spots[rows[k], V]) > spots[rows[k], RADIUS]
                seen += free
    return seen / max(rim, 1)


@part_of_caller
def spread(state, x, y, radius):
    """Carry what is not seen on by the filter's reach in the high bits of `state`; share of the rim that this costs."""
    n = len(state)
    any_hidden = False
    for i in range(n):
        for j in range(n):
            if state[i, j] & 3:
                any_hidden = True
                for a in range(max(i - _SPREAD, 0), min(i + _SPREAD + 1, n)):
                    for b in range(max(j - _SPREAD, 0), min(j + _SPREAD + 1, n)):
                        state[a, b] |= 4
    if not any_hidden:
        return 0.0
    rim, lost = 0, 0
    for i in range(n):
        for j in range(n):
            if abs(np.hypot(j - x, i - y) - radius) < _RIM and state[i, j] & 3 != HIDDEN:
                rim += 1
                lost += state[i, j] > 3
    return lost / max(rim, 1)


@part_of_caller
def gather(state, filtered, values, x0, y0, reach):  # noqa: PLR0917
    """x, y from the first guess of the centre and value of each pixel that counts; its place; how many they are.

    As many more stand after them, all at (0, 0), as make up whole steps of the vectorised loops.
    """
    n = len(state)
    margin = (len(values) - n) // 2
    room = n * n + _VECTOR
    at, where = np.empty((3, room), np.float32), np.empty((2, room), np.uint32)
    worst, reach2 = np.uint8(3 if filtered else 255), np.float32(reach * reach)
    pixels = np.uint32(0)
    for i in range(n):
        y, row, seen = np.float32(i - y0), state[i], values[i + margin, margin:]
        for j in range(n):
            x = np.float32(j) - np.float32(x0)
            at[0, pixels], at[1, pixels], at[2, pixels] = x, y, seen[j]
            where[0, pixels], where[1, pixels] = np.uint32(i), np.uint32(j)
            counts = (x * x + y * y < reach2) & (row[j] & 3 != HIDDEN) & (row[j] <= worst)
            pixels += np.uint32(counts)  # without a branch: what does not count is written over
    count = int(pixels)
    whole = (count + _VECTOR - 1) // _VECTOR * _VECTOR
    at[:, count:whole], where[:, count:whole] = 0.0, 0
    return at[:, :whole].copy(), where[:, :whole].copy(), count


@fast
def along_both_axes(field, taps):
    """`field` convolved along both axes with the symmetric `taps`, without its margin of as many pixels."""
    t, width = len(taps) - 1, field.shape[1]
    out = in_one_row(field.reshape(-1), taps, width)
    return out.reshape(len(out) // width, width)[:, : width - 2 * t]


@fast
def in_one_row(field, taps, width):
    """The same of a field whose rows of `width` stand one after the other; of each row of the answer what lies in the
    margin means nothing."""
    t = len(taps) - 1
    size = len(field) - 2 * t * width
    once, twice = np.empty(size, np.float32), np.empty(size, np.float32)
    _along(field, taps, width, once)
    _along(once, taps, 1, twice[: size - 2 * t])
    twice[size - 2 * t :] = 0.0
    return twice


@fast
def _along(values, taps, step, out):
    """`values` convolved with `taps` that are `step` apart: long loops over neighbours, which are vectorised."""
    middle = (len(taps) - 1) * step
    before, at, after = values[middle - step :], values[middle:], values[middle + step :]
    for p in range(len(out)):
        out[p] = taps[0] * at[p] + taps[1] * (before[p] + after[p])
    for k in range(2, len(taps)):
        before, after, tap = values[middle - k * step :], values[middle + k * step :], taps[k]
        for p in range(len(out)):
            out[p] += tap * (before[p] + after[p])
