"""Kernels of `linear.py`: what is kept of a fit, and the step from there to another image."""

from typing import NamedTuple, Self

import numpy as np

from sightline.detection.columns import (
    AXIAL,
    BLUR,
    CHI2,
    CONTRAST,
    DIAGONAL,
    FITTED,
    RADIUS,
    STATUS,
    WANDERED,
    U,
    V,
)
from sightline.detection.fit import (
    CLIPPING_MARGIN_SD,
    MAX_ELLIPTICITY,
    MAX_JOINT,
    MAX_RIM_LOST,
    MIN_BLUR_PX,
    add_priors,
    assess,
    initial_values,
    inverse_sd_table,
    joint_rows,
    unsharpen,
    weigh,
)
from sightline.detection.shadow import (
    BACKGROUND_TERMS,
    BEAD_AXIAL,
    BEAD_BLUR,
    BEAD_DIAGONAL,
    BEAD_LARGE,
    BEAD_RADIUS,
    BEAD_TERMS,
    BEAD_X,
    BEAD_Y,
    LIGHT,
    SCATTER_TERMS,
    STOPPED_BY_BALL,
    STOPPED_BY_HOLE,
    fill_light,
    fill_slopes,
    normal_equations,
    solve,
    substitute,
)
from sightline.detection.window import (
    BEYOND,
    MARGIN,
    VECTOR,
    along_both_axes,
    gather_pixels,
    log_level,
    mark_near_unusable,
    pixel_states,
    window_light,
)
from sightline.kernels import FAST, exact, fast, kernel, squared

_MOST = BEAD_TERMS * MAX_JOINT + SCATTER_TERMS + BACKGROUND_TERMS  # parameters
_ROWS = _MOST + 2  # of `slopes`, for each pixel
_MAX_STEP_PX = 1.0  # of a neighbour, as in a fit
_MAX_LEVEL = 0.15  # change of the light, as a share: the weights are those of the earlier image [ours]
# Share of a window's pixels: noise alone clips 2 % where the model is 2 s.d. below the brightest value, and shifts the
# light by less than 1 % of its noise [calc]. The brightest pixel of an image always counts as clipped.
_MAX_CLIPPED = 0.02
_ALMOST = np.float32(0.9999)  # rounding of logarithms and exponentials
LEFT, TOP, SIDE = range(3)
BEADS, PIXELS, COUNTING, FIRST, LIGHT_FIRST = range(5)
X0, Y0, ZERO, REACH = range(4)


class Windows(NamedTuple):
    """What is kept of the fits of M beads, with P pixels in all.

    `place` (M, 3): left, top and side of each window. `counts` (M, 5): beads fitted jointly, 0 where the fit cannot be
    linear; pixels; those of them that count; their place among all, and that of the window's light. `sharp` (M,):
    whether the window is sharpened. `whole` (M,): whether it lies within the field. `origin` (M, 4): x and y of the
    bead's start in the window, log of the light that has the value 1, and the window's reach. `at` (M, 31): the
    parameters; `large` (M, 3): BEAD_LARGE of each bead; `pull` (M, 31): the priors' share of the gradient; `lower`
    (M, 31, 31): the factor of the normal equations. `slopes`: for each bead (parameters + 2, pixels): the light's
    derivatives, the light, and one, all over the noise's s.d.; `where` (2, P): the pixels' rows and columns. `light`:
    of all pixels of the windows.
    """

    place: np.ndarray
    counts: np.ndarray
    sharp: np.ndarray
    whole: np.ndarray
    origin: np.ndarray
    at: np.ndarray
    large: np.ndarray
    pull: np.ndarray
    lower: np.ndarray
    slopes: np.ndarray
    where: np.ndarray
    light: np.ndarray

    @classmethod
    def empty(cls, radius_px: np.ndarray) -> Self:
        """Return windows without content for beads of these radii (M,)."""
        m, reach = len(radius_px), radius_px + BEYOND
        pixels = np.ceil(np.pi * (reach + 1.0) ** 2).astype(np.int64) + VECTOR
        light = (2 * (reach.astype(np.int64) + 1 + MARGIN) + 1) ** 2
        count = np.zeros((m, 5), np.int64)
        count[:, FIRST], count[:, LIGHT_FIRST] = np.cumsum(pixels) - pixels, np.cumsum(light) - light
        return cls(
            place=np.zeros((m, 3), np.int64),
            counts=count,
            sharp=np.zeros(m, np.bool_),
            whole=np.zeros(m, np.bool_),
            origin=np.zeros((m, 4)),
            at=np.zeros((m, _MOST)),
            large=np.zeros((m, MAX_JOINT)),
            pull=np.zeros((m, _MOST)),
            lower=np.zeros((m, _MOST, _MOST)),
            slopes=np.empty(_ROWS * int(pixels.sum()), np.float32),
            where=np.empty((2, int(pixels.sum())), np.uint32),
            light=np.empty(int(light.sum()), np.float32),
        )


@exact
def _pixels_of(slopes, first, size, pixels):
    """Return a bead's part of `Windows.slopes` (size + 2, pixels)."""
    return slopes[first * _ROWS : first * _ROWS + (size + 2) * pixels].reshape(size + 2, pixels)


@exact
def _count(values, least) -> int:
    """Return how many `values` (N, M) are `least` or more."""
    count = 0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            count += values[i, j] >= least
    return count


@exact
def _in_field(mask, left, top, n) -> bool:
    height, width = mask.shape
    if left < 0 or top < 0 or left + n > width or top + n > height:
        return False
    for i in range(top, top + n):
        for j in range(left, left + n):
            if not mask[i, j]:
                return False
    return True


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def keep_part(part, parts, image, usable, mask, spots, fitted, which, noise, sharpening, plain, tables, prior_sd, kept):  # noqa: PLR0915, PLR0917
    """Fill `kept` for the rows `which[part::parts]` of `spots`, whose fits are in `fitted`; as `fit_part`."""
    unit_sds = inverse_sd_table(noise[1])
    for i in range(part, len(which), parts):
        row = which[i]
        reach = spots[row, RADIUS] + BEYOND
        rows = joint_rows(spots, row, reach, prior_sd)
        half = int(reach) + 1
        left, top, side = int(spots[row, U] + 0.5) - half, int(spots[row, V] + 0.5) - half, 2 * half + 1
        zero = log_level(image, usable, spots[row], reach)
        light = window_light(image, left, top, half, zero)
        state = pixel_states(image, usable, spots, rows, left, top, side, noise[2])
        if _count(light[MARGIN:-MARGIN, MARGIN:-MARGIN], _ALMOST * np.exp(noise[2] - zero)) > _MAX_CLIPPED * state.size:
            continue
        table, stopped = (tables[0], STOPPED_BY_BALL) if spots[row, CONTRAST] < 0 else (tables[1], STOPPED_BY_HOLE)
        size = BEAD_TERMS * len(rows) + SCATTER_TERMS + BACKGROUND_TERMS
        x0, y0 = spots[row, U] - left, spots[row, V] - top
        sharp = mark_near_unusable(state, x0, y0, spots[row, RADIUS]) < MAX_RIM_LOST
        taps, gain, blur2, together2 = (sharpening if sharp else plain)[:4]
        at, where, counting = gather_pixels(
            state, sharp, along_both_axes(light, taps) if sharp else light, x0, y0, reach
        )
        initial = initial_values(spots, rows, blur2)[0]
        beads, scatter, background = initial_values(fitted, rows, blur2)
        for k in range(len(rows)):
            beads[k, BEAD_X] += fitted[row, U] - spots[row, U]
            beads[k, BEAD_Y] += fitted[row, V] - spots[row, V]
            kept.large[i, k] = beads[k, BEAD_LARGE]
        _joined(beads, scatter, background, kept.at[i])
        pixels = at.shape[1]
        columns, inverse_sd = np.empty((size + 3, pixels), np.float32), np.empty(pixels, np.float32)
        behind, effect = np.empty((4, pixels), np.float32), np.empty((len(rows), pixels), np.float32)
        A, L, b, step = np.empty((size + 2, size + 2)), np.empty((size, size)), np.empty(size), np.zeros(size)
        prior, data = np.zeros(size), np.empty(size)
        optics = np.float32(1.0 / reach), stopped, np.float32(together2)
        inverse_sds = unit_sds / np.float32(np.exp(0.5 * (noise[0] - noise[1] * zero)) * np.sqrt(gain))
        brightest = np.exp(noise[2] - zero - CLIPPING_MARGIN_SD * np.exp(0.5 * (noise[0] - noise[1] * noise[2])))
        good, used = True, 0
        for turn in range(2):  # the first finds scatter and background
            beads, scatter, background = _split(kept.at[i], kept.large[i], len(rows))
            fill_light(table, at, beads, scatter, background, optics, behind, effect, columns)
            used = weigh(columns[LIGHT], counting, np.float32(brightest), inverse_sds, inverse_sd)
            fill_slopes(at, optics[0], inverse_sd, behind, effect, columns)
            normal_equations(columns, A, b)
            data[:] = b
            add_priors(beads, initial, rows, prior_sd, scatter, background, prior, A, b)
            good = good and used >= 2 * size and solve(A, b, L, step)
            if not good:
                break
            if turn == 0:
                for k in range(size):
                    kept.at[i, k] += step[k]
        if not good:
            continue
        first = kept.counts[i, FIRST]
        kept.place[i, LEFT], kept.place[i, TOP], kept.place[i, SIDE] = left, top, side
        kept.counts[i, BEADS], kept.counts[i, PIXELS], kept.counts[i, COUNTING] = len(rows), pixels, used
        kept.origin[i, X0], kept.origin[i, Y0], kept.origin[i, ZERO], kept.origin[i, REACH] = x0, y0, zero, reach
        kept.sharp[i], kept.whole[i] = sharp, _in_field(mask, left - MARGIN, top - MARGIN, side + 2 * MARGIN)
        slopes = _pixels_of(kept.slopes, first, size, pixels)
        for k in range(size):
            kept.pull[i, k] = b[k] - data[k]
            for m in range(k + 1):
                kept.lower[i, k, m] = L[k, m]
            slopes[k] = columns[k]
        for p in range(pixels):
            slopes[size, p], slopes[size + 1, p] = columns[LIGHT, p] * inverse_sd[p], inverse_sd[p]
            kept.where[0, first + p], kept.where[1, first + p] = where[0, p], where[1, p]
        values = light.reshape(-1)
        for p in range(len(values)):
            kept.light[kept.counts[i, LIGHT_FIRST] + p] = values[p]


@exact
def _joined(beads, scatter, background, out):
    """Write all parameters into `out`."""
    at = BEAD_TERMS * len(beads)
    for k in range(at):
        out[k] = beads[k // BEAD_TERMS, k % BEAD_TERMS]
    for m in range(SCATTER_TERMS):
        out[at + m] = scatter[m]
    for m in range(BACKGROUND_TERMS):
        out[at + SCATTER_TERMS + m] = background[m]


@exact
def _split(parameters, large, count):
    """Return beads (`count`, BEAD_LARGE + 1), scatter and background of what `_joined` wrote."""
    at = BEAD_TERMS * count
    last = at + SCATTER_TERMS
    beads = np.empty((count, BEAD_LARGE + 1))
    for k in range(at):
        beads[k // BEAD_TERMS, k % BEAD_TERMS] = parameters[k]
    for k in range(count):
        beads[k, BEAD_LARGE] = large[k]
    return beads, parameters[at:last].copy(), parameters[last : last + BACKGROUND_TERMS].copy()


@exact
def _read(pixels, mask, left, top, whole, lowest, scale, light):  # noqa: PLR0917
    """Fill `light` (n, n) with the pixels times `scale`, but for those outside the `mask`, unless all are in it."""
    n = len(light)
    if whole:
        for i in range(n):
            seen, row = pixels[top + i, left : left + n], light[i]
            for j in range(n):
                row[j] = max(np.float32(seen[j]), lowest) * scale
        return
    height, width = pixels.shape
    for i in range(max(-top, 0), min(n, height - top)):
        for j in range(max(-left, 0), min(n, width - left)):
            if mask[top + i, left + j]:
                light[i, j] = max(np.float32(pixels[top + i, left + j]), lowest) * scale


@fast
def _inner(one, other):
    total = np.float32(0.0)
    for p in range(len(one)):
        total += one[p] * other[p]
    return total


@exact
def _is_near(beads, step, reach_px) -> bool:
    """Whether a step stays where the fit is linear; `beads`: the parameters after it."""
    near = True
    for k in range(len(beads)):
        for m in (BEAD_X, BEAD_Y, BEAD_RADIUS):
            near &= abs(step[BEAD_TERMS * k + m]) < (reach_px if k == 0 else _MAX_STEP_PX)
    return near and np.hypot(beads[0, BEAD_AXIAL], beads[0, BEAD_DIAGONAL]) < MAX_ELLIPTICITY


@kernel(fastmath=FAST, error_model="numpy", nogil=True)
def step_part(part, parts, pixels, mask, lowest, ceiling, reach_px, dark, sharpening, plain, tables, kept, out):  # noqa: PLR0917
    """Write the linear fits `part::parts` in the image `pixels` into `out` (M, COUNT); WANDERED: not near enough.

    CHI2 becomes the sum of squares itself; the covariances stay.
    """
    for i in range(part, len(out), parts):
        out[i, STATUS] = WANDERED
        count, n, first = kept.counts[i, BEADS], kept.counts[i, PIXELS], kept.counts[i, FIRST]
        if count == 0:
            continue
        left, top, side = kept.place[i, LEFT], kept.place[i, TOP], kept.place[i, SIDE]
        sharp, wide, at = kept.sharp[i], side + 2 * MARGIN, kept.counts[i, LIGHT_FIRST]
        taps, gain, blur2, together2 = (sharpening if sharp else plain)[:4]
        size = BEAD_TERMS * count + SCATTER_TERMS + BACKGROUND_TERMS
        light = kept.light[at : at + wide * wide].copy().reshape(wide, wide)
        scale = np.float32(np.exp(-kept.origin[i, ZERO]))
        _read(pixels, mask, left - MARGIN, top - MARGIN, kept.whole[i], lowest, scale, light)
        values = along_both_axes(light, taps) if sharp else light
        margin = np.uint32((len(values) - side) // 2)
        slopes = _pixels_of(kept.slopes, first, size, n)
        where, model, inverse_sd = kept.where[:, first : first + n], slopes[size], slopes[size + 1]
        rest, place = np.empty(n, np.float32), np.empty((3, n), np.float32)
        x0, y0 = np.float32(kept.origin[i, X0]), np.float32(kept.origin[i, Y0])
        for p in range(n):
            y, x = where[0, p], where[1, p]
            place[0, p], place[1, p] = np.float32(x) - x0, np.float32(y) - y0
            rest[p] = values[y + margin, x + margin] * inverse_sd[p] - model[p]
        window = light[MARGIN:-MARGIN, MARGIN:-MARGIN]
        if _count(window, _ALMOST * ceiling * scale) > _MAX_CLIPPED * window.size:
            continue
        data, gradient, step = np.empty(size), np.empty(size), np.empty(size)
        for k in range(size):
            data[k] = _inner(slopes[k], rest)
            gradient[k] = data[k] + kept.pull[i, k]
        substitute(kept.lower[i, :size, :size], gradient, step)
        beads, scatter, background = _split(kept.at[i, :size] + step, kept.large[i], count)
        brighter = _inner(rest, model) / _inner(model, model)
        if abs(brighter) > _MAX_LEVEL or not _is_near(beads, step, reach_px[i]):
            continue
        for k in range(count):
            beads[k, BEAD_BLUR] = max(beads[k, BEAD_BLUR], MIN_BLUR_PX)
        table, stopped = (tables[0], STOPPED_BY_BALL) if dark[i] else (tables[1], STOPPED_BY_HOLE)
        inside = max((1.0 - stopped) * background[0] + scatter[0], 0.02 * background[0])
        out[i, CHI2] = _inner(rest, rest)
        for k in range(size):
            out[i, CHI2] -= data[k] * step[k]
        out[i, U], out[i, V] = left + kept.origin[i, X0] + beads[0, BEAD_X], top + kept.origin[i, Y0] + beads[0, BEAD_Y]
        out[i, RADIUS], out[i, AXIAL], out[i, DIAGONAL] = (
            beads[0, BEAD_RADIUS],
            beads[0, BEAD_AXIAL],
            beads[0, BEAD_DIAGONAL],
        )
        out[i, BLUR], out[i, CONTRAST] = (
            np.sqrt(max(squared(beads[0, BEAD_BLUR]) - blur2, 0.0)),
            np.log(inside / max(background[0], 1e-3)),
        )
        behind, effect = np.empty((4, n), np.float32), np.empty((count, n), np.float32)
        columns = np.empty((size + 3, n), np.float32)
        blur2_then = unsharpen(beads, place, where, light, blur2, together2)
        optics = np.float32(1.0 / kept.origin[i, REACH]), stopped, blur2_then
        fill_light(table, place, beads, scatter, background, optics, behind, effect, columns)
        assess(place, beads, gain, inverse_sd, kept.counts[i, COUNTING], behind, columns, out[i])
        out[i, STATUS] = FITTED
