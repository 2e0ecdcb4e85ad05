"""Candidates: places that differ from their surroundings, held to have a rim that lies on a circle."""

from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

from sightline.detection.noise import NoiseModel

# Extrema are looked for at half resolution, where a disc of 2 px under the usual blur is still well sampled. The bands
# of the first octave answer most to discs of 2, 3.4 and 4.8 px radius, the last to 38 px [calc].
_OCTAVES = 4
_HALF = 2
_BAND_RADIUS = 1.7  # disc that a band answers most to, in units of its finer Gaussian [calc]
_FINEST_RADIUS = 1.1  # the same for the band whose finer level is the half-size image itself, half-size px [calc]
_LOUDEST = 4.0  # a spot starts at this many noise deviations of its band [ours]
_FAINTEST = 0.08  # step of log intensity; a 3 mm steel ball under much scatter still makes 0.3 [ours]
_BAND_NOISE = 0.2  # of a band's answer, over the noise of a broad mean and the band's radius [calc]
_BAND_GAIN = 0.2  # least answer of a band to a disc of contrast 1 between two bands [calc: 0.25 at its own radius]
_RAYS = 16
_BESIDE = 3  # rays are averaged by so many in large discs
_COS, _SIN = (f(2 * np.pi * np.arange(_BESIDE * _RAYS) / (_BESIDE * _RAYS)) for f in (np.cos, np.sin))
_PLACES = 13  # samples along a ray
_LARGE = 10.0  # px; of larger discs rays are averaged
_SPACING = 0.12, 0.5  # between them: in radii, and the least, px
_SOUND = 0.4  # step of a ray beside the median of all, for the ray to count [ours]
# Circle and rim are found in turns: how far from the circle a rim point may lie, in radii, and how many must not lie
# further; a bead that a neighbour covers by a quarter of its rim keeps 12 [calc]. And the least such distance, px.
_TURNS = 3
_OFF_CIRCLE = 0.5, 0.2, 0.12
_LEAST_RAYS = 9, 10, 11
_LEAST_OFF = 0.8
_RIM_OF_A_BALL = 1.08  # radius over that of the steepest rim: a ball thins out towards its rim [twin: 1.04-1.10]
_LEAST_SNR = 4.5  # step times root of the disc's area over the noise of a broad mean [ours]
_CHUNKS = 32
_ROOM = 2048  # extrema per chunk of rows

# Columns of an extremum (the first four) and of a candidate.
_U, _V, _RADIUS, _RESPONSE, _SCORE, _HOLLOW = range(6)


@dataclass(frozen=True, eq=False)
class Candidates:
    """What may be beads, best first: `uv_px` (N, 2), good to some 0.3 px; `radius_px` (N,), to some 5 %.

    `response` (N,): signed step of log intensity at the rim; `hollow` (N,): share of that step that the middle lacks;
    `round` (N,) bool: False for what is too much like a disc to be passed over in silence, but is none.
    """

    uv_px: np.ndarray
    radius_px: np.ndarray
    response: np.ndarray
    hollow: np.ndarray
    round: np.ndarray

    def __len__(self) -> int:
        return len(self.response)


def find_candidates(log_image: np.ndarray, mask: np.ndarray, noise: NoiseModel) -> Candidates:
    """Round spots inside `mask` of a log image (H, W) float32 that is filled outside it, one per place."""
    base = cv2.GaussianBlur(log_image, (5, 5), 0.8)
    half = cv2.resize(log_image, None, fx=1 / _HALF, fy=1 / _HALF, interpolation=cv2.INTER_AREA)
    finest, first = cv2.GaussianBlur(half, (3, 3), 0.5), cv2.GaussianBlur(half, (7, 7), 1.0)
    line = np.array([noise.offset + 2 * np.log(1 + 2 * noise.correlation[1:].sum()), noise.slope])
    extrema = _extrema(finest, first, mask, _HALF, _FINEST_RADIUS, line)
    for octave in range(_OCTAVES):
        step = _HALF << octave
        second = cv2.GaussianBlur(first, (7, 7), 1.0)
        third = cv2.GaussianBlur(second, (9, 9), 2**0.5)
        extrema += _extrema(first, second, mask, step, _BAND_RADIUS, line)
        extrema += _extrema(second, third, mask, step, _BAND_RADIUS * 2**0.5, line)
        first = np.ascontiguousarray(third[::2, ::2])
    spots = _judged(base, np.concatenate(extrema), line)
    spots = spots[spots[:, _RADIUS] > 0]
    spots = spots[np.argsort(-spots[:, _SCORE], kind="stable")]
    spots = spots[distinct(spots)]
    radius = spots[:, _RADIUS] * np.where(spots[:, _RESPONSE] < 0, _RIM_OF_A_BALL, 1.0)
    return Candidates(spots[:, :2], radius, spots[:, _RESPONSE], spots[:, _HOLLOW], spots[:, _SCORE] > 0)


def _extrema(fine, coarse, mask, step: int, radius: float, line) -> list[np.ndarray]:  # noqa: PLR0917
    """Local extrema of a band of the pyramid, `step` image px per pixel, that answers most to discs of `radius` px."""
    if min(fine.shape) < 5:
        return []
    counts, rows = _band(fine, coarse, mask, step, radius * step, line)
    return [rows[i, :n] for i, n in enumerate(counts)]


@nb.njit(parallel=True, cache=True, fastmath=True)
def _band(fine, coarse, mask, step, radius, line):  # noqa: PLR0917
    height, width = fine.shape
    counts = np.zeros(_CHUNKS, np.int64)
    rows = np.empty((_CHUNKS, _ROOM, 4))
    faintest = np.float32(_BAND_GAIN * _FAINTEST)
    for chunk in nb.prange(_CHUNKS):
        n = 0
        for y in range(max(1, chunk * height // _CHUNKS), min(height - 1, (chunk + 1) * height // _CHUNKS)):
            for x in range(1, width - 1):
                value = fine[y, x] - coarse[y, x]
                if abs(value) < faintest or not _is_extremum(fine, coarse, y, x, value):
                    continue
                if abs(value) < _LOUDEST * _BAND_NOISE * _broad_noise(coarse[y, x], line) / radius:
                    continue
                if not mask[y * step, x * step] or n == _ROOM:
                    continue
                left, right = fine[y, x - 1] - coarse[y, x - 1], fine[y, x + 1] - coarse[y, x + 1]
                above, below = fine[y - 1, x] - coarse[y - 1, x], fine[y + 1, x] - coarse[y + 1, x]
                bend_u, bend_v = left - 2 * value + right, above - 2 * value + below
                u = x + (0.5 * (left - right) / bend_u if abs(bend_u) > 1e-9 else 0.0)
                v = y + (0.5 * (above - below) / bend_v if abs(bend_v) > 1e-9 else 0.0)
                # Pixel 0 of the half-size image is centred between pixels 0 and 1 of the image.
                rows[chunk, n, _U] = u * step + 0.5 * (_HALF - 1)
                rows[chunk, n, _V] = v * step + 0.5 * (_HALF - 1)
                rows[chunk, n, _RADIUS], rows[chunk, n, _RESPONSE] = radius, value
                n += 1
        counts[chunk] = n
    return counts, rows


@nb.njit(cache=True, fastmath=True)
def _broad_noise(level, line) -> float:
    """Noise of a mean over many pixels, times the root of their number, where the log intensity is `level`."""
    return np.exp(0.5 * (line[0] - line[1] * level))


@nb.njit(cache=True, fastmath=True)
def _is_extremum(fine, coarse, y, x, value) -> bool:
    sign = 1.0 if value > 0 else -1.0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if (dy != 0 or dx != 0) and sign * (fine[y + dy, x + dx] - coarse[y + dy, x + dx]) > sign * value:
                return False
    return True


@nb.njit(parallel=True, cache=True, fastmath=True)
def _judged(base, extrema, line):
    """A candidate for each extremum: radius 0 where nothing like a disc is, score 0 where its rim is not round."""
    out = np.zeros((len(extrema), 6))
    chunks = min(len(extrema), 64)
    for chunk in nb.prange(chunks):
        seen, rim, step, ordered = (
            np.empty((_RAYS, _PLACES), np.float32),
            np.empty(_RAYS),
            np.empty(_RAYS),
            np.empty(_RAYS),
        )
        for i in range(chunk, len(extrema), chunks):
            _judge(base, extrema[i], line, seen, rim, step, ordered, out[i])
    return out


@nb.njit(cache=True, fastmath=True)
def _judge(base, start, line, seen, rim, step, ordered, out):  # noqa: PLR0917
    """From an extremum to the circle through its rim points, and how many of them lie on it."""
    u, v, radius, sign = start[_U], start[_V], start[_RADIUS], 1.0 if start[_RESPONSE] > 0 else -1.0
    height, width = base.shape
    noise = _broad_noise(_at(base, v, u, height, width), line)
    if not _has_all_sides(base, u, v, radius, sign, noise):
        return
    sound, middle = 0, 0.0
    for turn in range(_TURNS):
        spacing = max(_SPACING[0] * radius, _SPACING[1])
        first = max(radius - (_PLACES // 2) * spacing, 0.3)
        _cast(base, u, v, first, spacing, sign, turn == _TURNS - 1 and radius > _LARGE, seen)
        _steepest(seen, first, spacing, rim, step)
        middle = _median(step, ordered)
        if middle < max(_FAINTEST, _LEAST_SNR * 0.56 * noise / radius):
            return
        slack = max(_OFF_CIRCLE[turn] * radius, _LEAST_OFF)
        sound, du, dv, radius = _circle(rim, step, _SOUND * middle, slack, radius, ordered)
        u, v = u + du, v + dv
        if turn == _TURNS - 1:
            out[_U], out[_V], out[_RADIUS], out[_RESPONSE] = u, v, radius, sign * middle
        far = (u - start[_U]) ** 2 + (v - start[_V]) ** 2 > (0.8 * start[_RADIUS] + 1) ** 2
        if sound < _LEAST_RAYS[turn] or far or not 0.5 * start[_RADIUS] < radius < 2.0 * start[_RADIUS]:
            return
    step_all = _step_at(base, u, v, radius, sign)
    if step_all < max(_FAINTEST, _LEAST_SNR * 0.56 * noise / radius):
        return
    out[_SCORE] = middle * np.sqrt(radius) * sound**2
    out[_HOLLOW] = _hollow(base, u, v, radius, sign) / middle


@nb.njit(cache=True, fastmath=True)
def _has_all_sides(base, u, v, radius, sign, noise) -> bool:  # noqa: PLR0917
    """Whether it goes down from within the disc to without in 6 of 8 directions at least."""
    height, width = base.shape
    falls, whole = np.empty(8), 0.0
    for k in range(8):
        c, s = _COS[2 * _BESIDE * k], _SIN[2 * _BESIDE * k]
        inner = _at(base, v + 0.4 * radius * s, u + 0.4 * radius * c, height, width)
        outer = _at(base, v + 1.7 * radius * s, u + 1.7 * radius * c, height, width)
        falls[k] = sign * (inner - outer)
        whole += falls[k] / 8
    if whole < max(0.8 * _FAINTEST, 0.8 * _LEAST_SNR * 0.56 * noise / radius):
        return False
    down = 0
    for k in range(8):
        down += falls[k] > 0.3 * whole
    return down >= 6


@nb.njit(cache=True, fastmath=True)
def _cast(base, u, v, first, spacing, sign, averaged, seen):  # noqa: PLR0917
    """Signed values along rays from (u, v), or their means with the rays beside."""
    height, width = base.shape
    for k in range(_RAYS):
        seen[k] = 0.0
        for b in range(-1, 2) if averaged else range(1):
            c, s = _COS[_BESIDE * k + b], _SIN[_BESIDE * k + b]
            for j in range(_PLACES):
                r = first + j * spacing
                seen[k, j] += sign * _at(base, v + r * s, u + r * c, height, width)
        if averaged:
            seen[k] /= _BESIDE


@nb.njit(cache=True, fastmath=True)
def _steepest(seen, first, spacing, rim, step):
    """Per ray where it falls most, and by how much it falls about there."""
    for k in range(_RAYS):
        best, at = -1e9, 1
        for j in range(1, _PLACES - 1):
            fall = seen[k, j - 1] - seen[k, j + 1]
            if fall > best:
                best, at = fall, j
        shift = 0.0
        if 1 < at < _PLACES - 2:
            before, after = seen[k, at - 2] - seen[k, at], seen[k, at] - seen[k, at + 2]
            bend = before - 2 * best + after
            shift = 0.5 * (before - after) / bend if bend < -1e-9 else 0.0
        rim[k] = first + (at + min(max(shift, -1.0), 1.0)) * spacing
        step[k] = seen[k, max(at - 2, 0)] - seen[k, min(at + 2, _PLACES - 1)]


@nb.njit(cache=True, fastmath=True)
def _median(values, ordered) -> float:
    """Median of the rays' values; `ordered` is overwritten."""
    for k in range(_RAYS):
        j = k
        while j > 0 and ordered[j - 1] > values[k]:
            ordered[j] = ordered[j - 1]
            j -= 1
        ordered[j] = values[k]
    return 0.5 * (ordered[_RAYS // 2 - 1] + ordered[_RAYS // 2])


@nb.njit(cache=True, fastmath=True)
def _circle(rim, step, least, slack, radius, ordered):  # noqa: PLR0917
    """How many rim points lie within `slack` of a circle, its middle from here, its radius: r = R + a cos + b sin."""
    a = b = 0.0
    size = _median(rim, ordered)
    sound = 0
    for _ in range(3):
        n = c1 = s1 = cc = ss = cs = r1 = rc = rs = 0.0
        for k in range(_RAYS):
            c, s = _COS[_BESIDE * k], _SIN[_BESIDE * k]
            if step[k] < least or abs(rim[k] - size - a * c - b * s) > slack:
                continue
            n += 1
            c1, s1, cc, ss, cs = c1 + c, s1 + s, cc + c * c, ss + s * s, cs + c * s
            r1, rc, rs = r1 + rim[k], rc + rim[k] * c, rs + rim[k] * s
        sound = int(n)
        if sound < 6:
            return sound, a, b, radius
        c1, s1, r1 = c1 / n, s1 / n, r1 / n
        cc, ss, cs, rc, rs = cc / n - c1 * c1, ss / n - s1 * s1, cs / n - c1 * s1, rc / n - r1 * c1, rs / n - r1 * s1
        whole = cc * ss - cs * cs
        if whole < 1e-3:
            return 0, a, b, radius
        a, b = (ss * rc - cs * rs) / whole, (cc * rs - cs * rc) / whole
        size = r1 - a * c1 - b * s1
    return sound, a, b, size


@nb.njit(cache=True, fastmath=True)
def _step_at(base, u, v, radius, sign) -> float:
    """Mean within a circle less mean around it: linear in the image, so that noise does not add to it."""
    height, width = base.shape
    step = 0.0
    within, around = max(0.7 * radius, radius - 2.0), max(1.3 * radius, radius + 1.5)
    for k in range(_RAYS):
        c, s = _COS[_BESIDE * k], _SIN[_BESIDE * k]
        step += _at(base, v + within * s, u + within * c, height, width)
        step -= _at(base, v + around * s, u + around * c, height, width)
    return sign * step / _RAYS


@nb.njit(cache=True, fastmath=True)
def _hollow(base, u, v, radius, sign) -> float:
    """By how much the middle of a disc falls short of a ring at three quarters of its radius."""
    height, width = base.shape
    middle, ring = _at(base, v, u, height, width), 0.0
    for k in range(8):
        c, s = _COS[2 * _BESIDE * k], _SIN[2 * _BESIDE * k]
        middle += _at(base, v + 0.15 * radius * s, u + 0.15 * radius * c, height, width)
        ring += _at(base, v + 0.75 * radius * s, u + 0.75 * radius * c, height, width)
    return sign * (ring / 8 - middle / 9)


@nb.njit(cache=True, fastmath=True)
def _at(image, v, u, height, width) -> float:
    """Bilinear value; the border repeats."""
    v, u = min(max(v, 0.0), height - 1.001), min(max(u, 0.0), width - 1.001)
    i, j = int(v), int(u)
    b, a = v - i, u - j
    top = image[i, j] * (1 - a) + image[i, j + 1] * a
    return top * (1 - b) + (image[i + 1, j] * (1 - a) + image[i + 1, j + 1] * a) * b


@nb.njit(cache=True)
def distinct(spots: np.ndarray) -> np.ndarray:
    """Which spots, best first, do not repeat a better one: its circle's middle within half a radius of theirs."""
    cell = 32.0
    n = len(spots)
    keep = np.ones(n, np.bool_)
    if n == 0:
        return keep
    columns, lines = int(spots[:, _U].max() / cell) + 2, int(spots[:, _V].max() / cell) + 2
    head = np.full((lines, columns), -1, np.int64)
    following = np.full(n, -1, np.int64)
    for i in range(n):
        u, v, radius = spots[i, _U], spots[i, _V], spots[i, _RADIUS]
        row, column = int(max(v, 0.0) / cell), int(max(u, 0.0) / cell)
        for y in range(max(row - 1, 0), min(row + 2, lines)):
            for x in range(max(column - 1, 0), min(column + 2, columns)):
                j = head[y, x]
                while j >= 0 and keep[i]:
                    larger = max(radius, spots[j, _RADIUS])
                    apart = (spots[j, _U] - u) ** 2 + (spots[j, _V] - v) ** 2
                    keep[i] = apart > (0.5 * larger) ** 2
                    j = following[j]
        if keep[i]:
            following[i] = head[row, column]
            head[row, column] = i
    return keep
