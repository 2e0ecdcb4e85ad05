"""Candidates: spots with a rim on every side, looked for in a pyramid of scales."""

from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

_OCTAVES = 5  # discs of 1.7 px at the first band to 38 px at the last: radii of 2-25 px with a margin
_BANDS = (1.0, 2**0.5)  # finer Gaussian of each band, level px; the coarser is sqrt 2 wider
_BAND_RADIUS = 1.7  # disc that a band answers most to, in units of its finer Gaussian [calc]
_LOUDEST = 4.0  # a spot starts at this many noise deviations of its band; the fit asks for more [ours]
_FAINTEST = 0.04  # step of log intensity; a 3 mm steel ball under much scatter still makes 0.3 [ours]
_BAND_GAIN = 0.2  # least answer of a band to a disc of contrast 1 between two bands [calc: 0.25 at its own radius]
_LEAST_SNR = 4.5  # step times root of the disc's area over the noise of a broad mean [ours]
_SECTORS = 8
# Radii at which the rim is looked for, in units of the band's disc, and offsets added to them, px.
_AT = np.array([0.3, 0.5, 0.7, 0.9, 1.1, 1.3, 1.5, 1.75])
_COMPACT = 0.42  # share of the whole step that its steepest two of seven intervals hold; a smooth blob 0.35 [calc]
_ONE_SIDED = 0.35  # third weakest sector's step beside the median; a straight edge or a wire 0 or less [calc]
_CHUNKS = 64
_ROOM = 512  # spots per chunk of rows

# Columns of a spot.
_U, _V, _RADIUS, _RESPONSE, _SCORE = range(5)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Spots: `uv_px` (N, 2), `radius_px` (N,), `response` (N,) signed step of log intensity, `round` (N,) bool."""

    uv_px: np.ndarray
    radius_px: np.ndarray
    response: np.ndarray
    round: np.ndarray

    def __len__(self) -> int:
        return len(self.response)


def find_candidates(log_image: np.ndarray, noise_sd: float) -> Candidates:
    """Spots of a log image (H, W) float32 that is filled outside its field, one per place.

    `noise_sd` is the noise that a mean over many pixels would have, times the root of their number.
    """
    base = cv2.GaussianBlur(log_image, (7, 7), 1.0)
    spots, level = [], base
    for octave in range(_OCTAVES):
        second = cv2.GaussianBlur(level, (7, 7), 1.0)
        third = cv2.GaussianBlur(second, (9, 9), 2**0.5)
        sd = noise_sd / np.sqrt(4 * np.pi)  # of one pixel of `base`, a Gaussian of sigma 1
        counts, rows = _spots(level, second, third, base, 2**octave, sd)
        spots += [rows[i, :n] for i, n in enumerate(counts)]
        level = np.ascontiguousarray(third[::2, ::2])
    return _one_per_place(np.concatenate(spots))


def _one_per_place(spots: np.ndarray) -> Candidates:
    spots = spots[np.argsort(-spots[:, _SCORE], kind="stable")]
    spots = spots[_strongest(spots)]
    return Candidates(spots[:, :2], spots[:, _RADIUS], spots[:, _RESPONSE], spots[:, _SCORE] > 0)


@nb.njit(cache=True)
def _strongest(spots: np.ndarray) -> np.ndarray:
    """Which spots, sorted by score, do not repeat a better one of the same sign."""
    cell = 16.0
    n = len(spots)
    keep = np.ones(n, np.bool_)
    if n == 0:
        return keep
    columns, lines = int(spots[:, _U].max() / cell) + 1, int(spots[:, _V].max() / cell) + 1
    head = np.full((lines, columns), -1, np.int64)
    following = np.full(n, -1, np.int64)
    for i in range(n):
        u, v, radius = spots[i, _U], spots[i, _V], spots[i, _RADIUS]
        row, column = int(v / cell), int(u / cell)
        reach = int(radius / cell) + 1
        for y in range(max(row - reach, 0), min(row + reach + 1, lines)):
            for x in range(max(column - reach, 0), min(column + reach + 1, columns)):
                j = head[y, x]
                while j >= 0 and keep[i]:
                    larger, smaller = max(radius, spots[j, _RADIUS]), min(radius, spots[j, _RADIUS])
                    apart = (spots[j, _U] - u) ** 2 + (spots[j, _V] - v) ** 2
                    alike = larger < 1.7 * smaller and spots[j, _RESPONSE] * spots[i, _RESPONSE] > 0
                    if alike and apart < (0.7 * larger) ** 2:
                        keep[i] = False
                    j = following[j]
        if keep[i]:
            following[i] = head[row, column]
            head[row, column] = i
    return keep


@nb.njit(parallel=True, cache=True, fastmath=True)
def _spots(first, second, third, base, step: int, sd: float) -> tuple[np.ndarray, np.ndarray]:  # noqa: PLR0917
    """Local extrema of both bands, graded: per chunk of rows their number and columns."""
    height, width = first.shape
    counts = np.zeros(_CHUNKS, np.int64)
    rows = np.empty((_CHUNKS, _ROOM, 5))
    # 0.408 sd / sigma: noise of a difference of Gaussians sqrt 2 apart [calc]
    least0 = max(_LOUDEST * 0.408 * sd / step / _BANDS[0], _BAND_GAIN * _FAINTEST)
    least1 = max(_LOUDEST * 0.408 * sd / step / _BANDS[1], _BAND_GAIN * _FAINTEST)
    for chunk in nb.prange(_CHUNKS):
        n = 0
        for y in range(max(2, chunk * height // _CHUNKS), min(height - 2, (chunk + 1) * height // _CHUNKS)):
            for x in range(2, width - 2):
                value = first[y, x] - second[y, x]
                if abs(value) > least0 and n < _ROOM and _is_extremum(first, second, y, x, value):
                    _grade(first, second, base, y, x, value, _BANDS[0], step, sd, rows[chunk, n])
                    n += rows[chunk, n, _SCORE] > -1
                value = second[y, x] - third[y, x]
                if abs(value) > least1 and n < _ROOM and _is_extremum(second, third, y, x, value):
                    _grade(second, third, base, y, x, value, _BANDS[1], step, sd, rows[chunk, n])
                    n += rows[chunk, n, _SCORE] > -1
        counts[chunk] = n
    return counts, rows


@nb.njit(cache=True, fastmath=True)
def _is_extremum(fine, coarse, y, x, value) -> bool:
    sign = 1.0 if value > 0 else -1.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if (dy != 0 or dx != 0) and sign * (fine[y + dy, x + dx] - coarse[y + dy, x + dx]) > sign * value:
                return False
    return True


@nb.njit(cache=True, fastmath=True)
def _grade(fine, coarse, base, y, x, value, sigma, step, sd, out):  # noqa: PLR0917
    """Sub-pixel place, radius of the steepest rim, and score: -1 nothing, 0 not round, else the step in noise."""
    left, right = fine[y, x - 1] - coarse[y, x - 1], fine[y, x + 1] - coarse[y, x + 1]
    above, below = fine[y - 1, x] - coarse[y - 1, x], fine[y + 1, x] - coarse[y + 1, x]
    bend_u, bend_v = left - 2 * value + right, above - 2 * value + below
    u = (x + (0.5 * (left - right) / bend_u if abs(bend_u) > 1e-9 else 0.0)) * step
    v = (y + (0.5 * (above - below) / bend_v if abs(bend_v) > 1e-9 else 0.0)) * step
    unit = _BAND_RADIUS * sigma * step
    sign = 1.0 if value > 0 else -1.0
    height, width = base.shape
    seen = np.empty((_SECTORS, len(_AT)))
    mean = np.zeros(len(_AT))
    for k in range(_SECTORS):
        c, s = np.cos(2 * np.pi * k / _SECTORS), np.sin(2 * np.pi * k / _SECTORS)
        for j in range(len(_AT)):
            r = _AT[j] * unit
            seen[k, j] = sign * _at(base, v + r * s, u + r * c, height, width)
            mean[j] += seen[k, j] / _SECTORS
    best, at = -1e9, 1
    for j in range(1, len(_AT) - 1):
        if mean[j - 1] - mean[j + 1] > best:
            best, at = mean[j - 1] - mean[j + 1], j
    whole = mean[0] - mean[-1]
    steps = np.empty(_SECTORS)
    for k in range(_SECTORS):
        steps[k] = seen[k, max(at - 2, 0)] - seen[k, min(at + 2, len(_AT) - 1)]
    steps.sort()
    middle = 0.5 * (steps[3] + steps[4])
    out[_U], out[_V], out[_RADIUS], out[_RESPONSE] = u, v, _AT[at] * unit, sign * middle
    out[_SCORE] = -1.0
    # `sd` is a broad mean's noise over sqrt(4 pi): the noise of a mean over the disc is 2 sd / radius.
    if middle < max(_FAINTEST, _LEAST_SNR * 2 * sd / out[_RADIUS]) or steps[2] < 0.1 * middle - 1.5 * sd:
        return
    slack = 2.0 * sd
    sided = steps[2] > _ONE_SIDED * middle - slack and steps[1] > -slack
    compact = best > _COMPACT * max(whole, 0.7 * middle) - 0.7 * sd
    out[_SCORE] = best / sd * np.sqrt(unit) if sided and compact else 0.0


@nb.njit(cache=True, fastmath=True)
def _at(image, v, u, height, width) -> float:
    """Bilinear value; the border repeats."""
    v, u = min(max(v, 0.0), height - 1.001), min(max(u, 0.0), width - 1.001)
    i, j = int(v), int(u)
    b, a = v - i, u - j
    top = image[i, j] * (1 - a) + image[i, j + 1] * a
    return top * (1 - b) + (image[i + 1, j] * (1 - a) + image[i + 1, j + 1] * a) * b
