"""Test candidates for a rim that lies on a circle, from the steepest point along sixteen rays."""

from typing import NamedTuple

import numpy as np

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts

EXTREMUM = np.dtype([(name, np.float64) for name in ("u_px", "v_px", "radius_px", "contrast")])
# `score`: 0 where the rim is not round. `hollow`: how much the middle lacks, over the contrast.
CANDIDATE = np.dtype([*EXTREMUM.descr, ("score", np.float64), ("hollow", np.float64)])
FAINTEST = 0.08  # step of log intensity; a 3 mm steel ball under much scatter still makes 0.3 [twin]
_RAYS = 16
_BESIDE = 3  # adjacent rays averaged in large discs
_ANGLE = 2 * np.pi * (np.arange(_RAYS) + np.array([[0], [1], [-1]]) / _BESIDE) / _RAYS  # the rays, and those beside
_COS, _SIN = np.cos(_ANGLE).astype(np.float32), np.sin(_ANGLE).astype(np.float32)
_PLACES = 13  # samples along a ray
_LARGE = 10.0  # px; rays are averaged in larger discs
_SPACING = 0.12, 0.5  # of the samples: in radii, and at least, px
_SOUND = 0.4  # smallest step of a ray over the median of all, for the ray to count [ours]
# Circle and rim are found in three iterations: largest distance of a rim point from the circle, in radii (at least
# _MIN_SLACK_PX), and smallest number of rim points within it. A bead with a quarter of its rim covered keeps 12 [calc].
_ITERATIONS = 3
_OFF_CIRCLE = 0.5, 0.2, 0.12
_MIN_RAYS = 9, 10, 11
_MIN_SLACK_PX = 0.8
_MIN_SNR = 4.5  # step times root of the disc's area over the noise of a broad mean [ours]
MIN_STEP_SNR = 0.56 * _MIN_SNR  # the same for the radius in place of the root


def _middle_network(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper indices, in order, of the comparisons after which the middle two of a power of two
    values are in their sorted places (Batcher's merge exchange; others may not be)."""
    pairs, p = [], 1
    while p < count:
        k = p
        while k >= 1:
            for j in range(k % p, count - k, 2 * k):
                for i in range(j, min(j + k, count - k)):
                    if i // (2 * p) == (i + k) // (2 * p):
                        pairs.append((i, i + k))
            k //= 2
        p *= 2
    matter, kept = {count // 2 - 1, count // 2}, []
    for pair in reversed(pairs):
        if matter & set(pair):
            matter |= set(pair)
            kept.append(pair)
    lower, upper = np.array(kept[::-1], np.uint32).T
    return lower.copy(), upper.copy()


_LOWER, _UPPER = _middle_network(_RAYS)


class _Sampler(NamedTuple):
    """Bilinear interpolation in an image: its `pixels`, row by row, and its `shape`; the border repeats.

    `x`, `y`, `at`: work space; `values`: those last interpolated.
    """

    pixels: np.ndarray
    shape: tuple[int, int]
    x: np.ndarray
    y: np.ndarray
    at: np.ndarray
    values: np.ndarray


@kernel()
def broad_noise(level, line) -> float:
    """Return the noise of a mean over many pixels, times the root of their number, at the log intensity `level`."""
    return np.exp(np.float32(0.5) * (line[0] - line[1] * level))


def judged(base: np.ndarray, extrema: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return a candidate for each extremum: radius 0 where there is no disc, score 0 where its rim is not round."""
    candidates = np.zeros(len(extrema), CANDIDATE)
    in_parts(_judge_part, base, extrema, line, candidates)
    return candidates


@kernel(nogil=True)
def _judge_part(part, parts, base, extrema, line, candidates):  # noqa: PLR0917 - a kernel
    """Fit a circle to the rim points around each extremum and write the candidate into its row of `candidates`."""
    # Made once: threads that count the references of one array a thousand times an image stall each other.
    seen = np.empty((_PLACES, _RAYS), np.float32)
    x, y, values = np.empty(seen.size, np.float32), np.empty(seen.size, np.float32), np.empty(seen.size, np.float32)
    sampler = _Sampler(base.reshape(-1), base.shape, x, y, np.empty(seen.size, np.uint32), values)
    rim, step, ordered = np.empty(_RAYS, np.float32), np.empty(_RAYS, np.float32), np.empty(_RAYS, np.float32)
    for i in range(part, len(extrema), parts):
        u, v, radius = extrema[i].u_px, extrema[i].v_px, extrema[i].radius_px
        first_u, first_v, first_radius, sign = u, v, radius, 1.0 if extrema[i].contrast > 0 else -1.0
        _two_rings(sampler, u, v, 0.4 * radius, 1.7 * radius, 2)
        noise = broad_noise(values[16], line)
        if not _has_all_sides(values, radius, sign, noise):
            continue
        sound, middle, is_disc = 0, 0.0, True
        for iteration in range(_ITERATIONS):
            spacing = max(_SPACING[0] * radius, _SPACING[1])
            first = max(radius - (_PLACES // 2) * spacing, 0.3)
            averaged = iteration == _ITERATIONS - 1 and radius > _LARGE
            _cast(sampler, u, v, first, spacing, sign, _BESIDE if averaged else 1, seen)
            _steepest(seen, first, spacing, rim, step)
            middle = _median(step, ordered)
            is_disc = middle >= max(FAINTEST, MIN_STEP_SNR * noise / radius)
            if not is_disc:
                break
            slack = max(_OFF_CIRCLE[iteration] * radius, _MIN_SLACK_PX)
            sound, du, dv, radius = _circle(rim, step, _SOUND * middle, slack, radius, ordered)
            u, v = u + du, v + dv
            if iteration == _ITERATIONS - 1:
                candidates[i].u_px, candidates[i].v_px, candidates[i].radius_px, candidates[i].contrast = (
                    u,
                    v,
                    radius,
                    sign * middle,
                )
            far = (u - first_u) ** 2 + (v - first_v) ** 2 > (0.8 * first_radius + 1) ** 2
            is_disc = sound >= _MIN_RAYS[iteration] and not far and 0.5 * first_radius < radius < 2.0 * first_radius
            if not is_disc:
                break
        if not is_disc:
            continue
        # The mean within a circle minus the mean around it: linear in the image, so noise causes no bias.
        inner, outer = max(0.7 * radius, radius - 2.0), max(1.3 * radius, radius + 1.5)
        _two_rings(sampler, u, v, inner, outer, 1)
        whole = 0.0
        for k in range(_RAYS):
            whole += values[k] - values[_RAYS + k]
        if sign * whole / _RAYS < max(FAINTEST, MIN_STEP_SNR * noise / radius):
            continue
        _two_rings(sampler, u, v, 0.15 * radius, 0.75 * radius, 2)
        core, ring = float(values[16]), 0.0
        for k in range(8):
            core += values[k]
            ring += values[8 + k]
        candidates[i].score = middle * np.sqrt(radius) * sound**2
        candidates[i].hollow = sign * (ring / 8 - core / 9) / middle


@kernel()
def _two_rings(sampler, u, v, inner, outer, every):  # noqa: PLR0917 - a kernel
    """Fill the sampler's values with those at `inner` px from (u, v), then those at `outer` px, and in the middle.

    `every`: 1 for all rays, 2 for every second.
    """
    count, x, y = _RAYS // every, sampler.x, sampler.y
    for k in range(count):
        c, s = _COS[0, every * k], _SIN[0, every * k]
        x[k], y[k] = u + inner * c, v + inner * s
        x[count + k], y[count + k] = u + outer * c, v + outer * s
    x[2 * count], y[2 * count] = u, v
    _interpolate(sampler, 2 * count + 1)


@kernel()
def _has_all_sides(values, radius, sign, noise) -> bool:
    """Return whether the values of two rings of 8 fall outwards in at least 5 directions; overwrites some."""
    whole = 0.0
    for k in range(8):
        values[k] = sign * (values[k] - values[8 + k])
        whole += values[k] / 8
    if whole < max(0.8 * FAINTEST, 0.8 * MIN_STEP_SNR * noise / radius):
        return False
    down = 0
    for k in range(8):
        down += values[k] > 0.3 * whole
    return down >= 5


@kernel()
def _cast(sampler, u, v, first, spacing, sign, beside, seen):  # noqa: PLR0917 - a kernel
    """Fill `seen` (_PLACES, _RAYS) with signed values along rays from (u, v), or their means over `beside` rays."""
    part, x, y, values = np.float32(sign / beside), sampler.x, sampler.y, sampler.values
    u, v = np.float32(u), np.float32(v)
    seen[:] = 0
    for b in range(beside):
        for j in range(_PLACES):
            r, first_ray = np.float32(first + j * spacing), j * _RAYS
            for k in range(_RAYS):
                x[first_ray + k], y[first_ray + k] = u + r * _COS[b, k], v + r * _SIN[b, k]
        _interpolate(sampler, seen.size)
        for j in range(_PLACES):
            for k in range(_RAYS):
                seen[j, k] += part * values[j * _RAYS + k]


@kernel()
def _interpolate(sampler, count):
    """Fill the first `count` values with those at `x`, `y`, which are overwritten.

    Places come first and values after them, so that the compiler vectorises the first loop and most of the second.
    """
    pixels, shape, x, y, at, values = sampler
    zero, last_x, last_y = np.float32(0), np.float32(shape[1] - 1.01), np.float32(shape[0] - 1.01)
    width, right = np.int32(shape[1]), np.uint32(1)
    below = np.uint32(width)
    for n in range(count):
        u, v = min(max(x[n], zero), last_x), min(max(y[n], zero), last_y)
        column, row = np.int32(u), np.int32(v)
        x[n], y[n] = u - np.float32(column), v - np.float32(row)
        at[n] = np.uint32(row * width + column)
    for n in range(count):
        k = at[n]
        top, low = pixels[k], pixels[k + below]
        top += (pixels[k + right] - top) * x[n]
        low += (pixels[k + below + right] - low) * x[n]
        values[n] = top + (low - top) * y[n]


@kernel()
def _steepest(seen, first, spacing, rim, step):
    """Fill `rim` and `step` with the place where each ray falls most steeply, and by how much it falls there."""
    for k in range(_RAYS):  # branch-free, so that it is vectorised over the rays
        most, at = seen[0, k] - seen[2, k], 1
        for j in range(2, _PLACES - 1):
            fall = seen[j - 1, k] - seen[j + 1, k]
            at = j if fall > most else at
            most = max(fall, most)
        rim[k], step[k] = at, most
    for k in range(_RAYS):
        at = int(rim[k])
        before, after = seen[max(at - 2, 0), k] - seen[at, k], seen[at, k] - seen[min(at + 2, _PLACES - 1), k]
        bend = before - 2 * step[k] + after
        peak = 1 < at < _PLACES - 2 and bend < -1e-9
        shift = min(max(0.5 * (before - after) / bend, -1.0), 1.0) if peak else 0.0
        rim[k], step[k] = first + (at + shift) * spacing, before + after


@kernel()
def _median(values, ordered) -> float:
    """Return the median of the rays' values; overwrites `ordered`."""
    for k in range(_RAYS):
        ordered[k] = values[k]
    for n in range(len(_LOWER)):
        i, j = _LOWER[n], _UPPER[n]
        x, y = ordered[i], ordered[j]
        ordered[i], ordered[j] = min(x, y), max(x, y)
    return 0.5 * (ordered[_RAYS // 2 - 1] + ordered[_RAYS // 2])


@kernel()
def _circle(rim, step, least, slack, radius, ordered):  # noqa: PLR0917
    """Fit r = R + a cos + b sin to the rim points; return how many lie within `slack`, the centre (a, b), and R."""
    a = b = 0.0
    size = _median(rim, ordered)
    sound = 0
    for _ in range(3):
        n = c1 = s1 = cc = ss = cs = r1 = rc = rs = 0.0
        for k in range(_RAYS):
            counts = (step[k] >= least) & (abs(rim[k] - size - a * _COS[0, k] - b * _SIN[0, k]) <= slack)
            ordered[k] = 1.0 if counts else 0.0
        for k in range(_RAYS):  # all rays with a weight: branches on noise stall the processor
            c, s, w = _COS[0, k], _SIN[0, k], float(ordered[k])
            n += w
            c1, s1, cc, ss, cs = c1 + w * c, s1 + w * s, cc + w * (c * c), ss + w * (s * s), cs + w * (c * s)
            r1, rc, rs = r1 + w * rim[k], rc + w * (rim[k] * c), rs + w * (rim[k] * s)
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
