"""Candidates: spots that differ from their surroundings on every side, in a pyramid of scales."""

from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

_OCTAVES = 5  # discs of 1.7 px at the first band to 38 px at the last: radii of 2-25 px with a margin
_BANDS = (1.0, 2**0.5)  # finer Gaussian of each band, level px; the coarser is sqrt 2 wider
_BAND_RADIUS = 1.7  # disc that a band answers most to, in units of its finer Gaussian [calc]
_LOUDEST = 4.0  # a spot starts at this many noise deviations of its band; the fit asks for more [ours]
_FAINTEST = 0.004  # log intensity; weaker than any bead in a readable image [ours]
_SECTORS = 8
_CHUNKS = 64
_ROOM = 256  # spots per chunk of rows


@dataclass(frozen=True, eq=False)
class Candidates:
    """Spots: `uv_px` (N, 2), `radius_px` (N,), `response` (N,) signed band-pass answer, `round` (N,) bool."""

    uv_px: np.ndarray
    radius_px: np.ndarray
    response: np.ndarray
    round: np.ndarray

    def __len__(self) -> int:
        return len(self.response)


def find_candidates(log_image: np.ndarray, noise_sd: float) -> Candidates:
    """Spots of a log image (H, W) float32 that is filled outside its field, strongest first, one per place.

    `noise_sd` is the noise that a mean over many pixels would have, times the root of their number.
    """
    spots = []
    level = cv2.GaussianBlur(log_image, (7, 7), 1.0)
    for octave in range(_OCTAVES):
        second = cv2.GaussianBlur(level, (7, 7), 1.0)
        third = cv2.GaussianBlur(second, (9, 9), 2**0.5)
        # Noise of one pixel of `level`, a Gaussian of sigma 1.
        sd = noise_sd / np.sqrt(4 * np.pi) / 2.0**octave
        counts, rows = _spots(level, second, third, sd)
        found = np.concatenate([rows[i, :n] for i, n in enumerate(counts)])
        found[:, :3] *= 2.0**octave
        spots.append(found)
        level = np.ascontiguousarray(third[::2, ::2])
    return _one_per_place(np.concatenate(spots))


def _one_per_place(spots: np.ndarray) -> Candidates:
    spots = spots[np.argsort(-np.abs(spots[:, 3]), kind="stable")]
    spots = spots[_strongest(spots)]
    return Candidates(spots[:, :2], spots[:, 2], spots[:, 3], spots[:, 4] > 0)


@nb.njit(cache=True)
def _strongest(spots: np.ndarray) -> np.ndarray:
    """Which spots, sorted by strength, do not repeat a stronger one of the same sign at a neighbouring scale."""
    cell = 16.0
    n = len(spots)
    keep = np.ones(n, np.bool_)
    if n == 0:
        return keep
    columns = int(spots[:, 0].max() / cell) + 1
    lines = int(spots[:, 1].max() / cell) + 1
    head = np.full((lines, columns), -1, np.int64)
    following = np.full(n, -1, np.int64)
    for i in range(n):
        u, v, radius = spots[i, 0], spots[i, 1], spots[i, 2]
        reach = int(radius * 1.5 / cell) + 1
        row, column = int(v / cell), int(u / cell)
        for y in range(max(row - reach, 0), min(row + reach + 1, lines)):
            for x in range(max(column - reach, 0), min(column + reach + 1, columns)):
                j = head[y, x]
                while j >= 0 and keep[i]:
                    larger, smaller = max(radius, spots[j, 2]), min(radius, spots[j, 2])
                    near = (spots[j, 0] - u) ** 2 + (spots[j, 1] - v) ** 2 < (0.6 * larger) ** 2
                    if near and larger < 3.0 * smaller and spots[j, 3] * spots[i, 3] > 0 and spots[j, 4] >= spots[i, 4]:
                        keep[i] = False
                    j = following[j]
        if keep[i]:
            following[i] = head[row, column]
            head[row, column] = i
    return keep


@nb.njit(parallel=True, cache=True, fastmath=True)
def _spots(first: np.ndarray, second: np.ndarray, third: np.ndarray, sd: float) -> tuple[np.ndarray, np.ndarray]:
    """Local extrema of both bands, graded: per chunk of rows their number and (u, v, radius, response, round)."""
    height, width = first.shape
    counts = np.zeros(_CHUNKS, np.int64)
    rows = np.empty((_CHUNKS, _ROOM, 5))
    for chunk in nb.prange(_CHUNKS):
        n = 0
        for y in range(max(2, chunk * height // _CHUNKS), min(height - 2, (chunk + 1) * height // _CHUNKS)):
            for x in range(2, width - 2):
                for band in range(2):
                    fine, coarse = (first, second) if band == 0 else (second, third)
                    value = fine[y, x] - coarse[y, x]
                    # 0.408 sd / sigma: noise of a difference of Gaussians sqrt 2 apart [calc]
                    if abs(value) < max(_LOUDEST * 0.408 * sd / _BANDS[band], _FAINTEST) or n >= _ROOM:
                        continue
                    if not _is_extremum(fine, coarse, y, x, value):
                        continue
                    radius = _BAND_RADIUS * _BANDS[band]
                    rows[chunk, n, 0] = x
                    rows[chunk, n, 1] = y
                    rows[chunk, n, 2] = radius
                    rows[chunk, n, 3] = value
                    rows[chunk, n, 4] = _is_round(first, y, x, radius, 1.0 if value > 0 else -1.0, sd)
                    n += 1
        counts[chunk] = n
    return counts, rows


@nb.njit(cache=True, fastmath=True)
def _is_extremum(fine: np.ndarray, coarse: np.ndarray, y: int, x: int, value: float) -> bool:
    sign = 1.0 if value > 0 else -1.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if (dy != 0 or dx != 0) and sign * (fine[y + dy, x + dx] - coarse[y + dy, x + dx]) > sign * value:
                return False
    return True


@nb.njit(cache=True, fastmath=True)
def _is_round(image: np.ndarray, y: int, x: int, radius: float, sign: float, sd: float) -> bool:
    """Whether (nearly) every sector of a ring just outside differs from the ring just inside, in the same sense."""
    height, width = image.shape
    steps = np.empty(_SECTORS)
    for k in range(_SECTORS):
        c, s = np.cos(2 * np.pi * k / _SECTORS), np.sin(2 * np.pi * k / _SECTORS)
        inner = _at(image, y + 0.5 * radius * s, x + 0.5 * radius * c, height, width)
        outer = _at(image, y + (radius + 1.5) * s, x + (radius + 1.5) * c, height, width)
        steps[k] = sign * (inner - outer)
    steps.sort()
    middle = 0.5 * (steps[3] + steps[4])
    return middle > 0 and steps[1] > 0.3 * middle - 3.0 * sd


@nb.njit(cache=True, fastmath=True)
def _at(image: np.ndarray, v: float, u: float, height: int, width: int) -> float:
    """Bilinear value; the border repeats."""
    v, u = min(max(v, 0.0), height - 1.001), min(max(u, 0.0), width - 1.001)
    i, j = int(v), int(u)
    b, a = v - i, u - j
    top = image[i, j] * (1 - a) + image[i, j + 1] * a
    return top * (1 - b) + (image[i + 1, j] * (1 - a) + image[i + 1, j + 1] * a) * b
