"""Ray-casting: lengths and attenuation along the rays of an image. Compiled, parallel over rows of the image."""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from sightline.twin.things import COLUMNS

CELL_PX = 16
SUB = 4  # sub-rays per pixel and axis
assert COLUMNS == 9  # noqa: S101 - the kernels below spell the columns out


class Rays(NamedTuple):
    """The rays of an image, CFCS: from `focal` (3,) to `points` (H, W, 3) on the input plane; only those `inside`."""

    focal: np.ndarray
    points: np.ndarray
    inside: np.ndarray


@njit(cache=True)
def _towards(rays: Rays, r: int, c: int, d: np.ndarray) -> float:
    """Fills `d` (3,) with the way from focal point to input plane of one pixel; its length, mm."""
    norm = 0.0
    for a in range(3):
        d[a] = rays.points[r, c, a] - rays.focal[a]
        norm += d[a] * d[a]
    return np.sqrt(norm)


@njit(cache=True)
def _within(span: tuple[float, float], start: float, slope: float, low: float, high: float) -> tuple[float, float]:
    """The part of a span of t (near, far) where start + t slope lies between low and high; far < near: none."""
    near, far = span
    if abs(slope) < 1e-12:
        return (near, far) if low <= start <= high else (0.0, -1.0)
    t0, t1 = (low - start) / slope, (high - start) / slope
    return max(near, min(t0, t1)), min(far, max(t0, t1))


# Sums may be taken in any order: that lets eight samples be taken at a time, and changes no bit of a float32 result.
@njit(cache=True, parallel=True, fastmath={"reassoc", "contract"})
def volume_integral(rays: Rays, values: np.ndarray, origin: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    """(H, W) mm: integral of a volume along each ray, trilinear, a sample per shortest voxel edge. 0 where not inside.

    `values` (nx, ny, nz), C-contiguous, value [i, j, k] at origin + voxel * (i, j, k); nothing beyond them. `voxel`
    (3,) mm; at least two voxels a side.
    """
    focal, _, inside = rays
    h, w = inside.shape
    out = np.zeros((h, w), dtype=np.float32)
    flat = values.ravel()
    ni, nj = values.shape[1] * values.shape[2], values.shape[2]
    shape = values.shape
    unit = voxel[0]
    ratio = unit / voxel
    most = ratio.max()
    start = (focal - origin) / unit * ratio
    for r in prange(h):
        d = np.empty(3)
        for c in range(w):
            if not inside[r, c]:
                continue
            norm = _towards(rays, r, c, d)
            span = (0.0, norm / unit)
            for a in range(3):
                d[a] = d[a] / norm * ratio[a]
                span = _within(span, start[a], d[a], 0.0, shape[a] - 1.001)
            near, far = span
            if far <= near:
                continue
            steps = int((far - near) * most) + 1
            step = (far - near) / steps
            total = 0.0
            for s in range(steps):
                t = near + (s + 0.5) * step
                x, y, z = start[0] + t * d[0], start[1] + t * d[1], start[2] + t * d[2]
                i, j, k = np.int32(x), np.int32(y), np.int32(z)
                fx, fy, fz = x - i, y - j, z - k
                at = i * ni + j * nj + k  # unsigned below: no index counts from the end
                a00, a01 = np.uint64(at), np.uint64(at + nj)
                a10, a11 = np.uint64(at + ni), np.uint64(at + ni + nj)
                up = np.uint64(1)
                low = (1 - fy) * flat[a00] + fy * flat[a01]
                low_up = (1 - fy) * flat[a00 + up] + fy * flat[a01 + up]
                high = (1 - fy) * flat[a10] + fy * flat[a11]
                high_up = (1 - fy) * flat[a10 + up] + fy * flat[a11 + up]
                total += (1 - fx) * ((1 - fz) * low + fz * low_up) + fx * ((1 - fz) * high + fz * high_up)
            out[r, c] = total * step * unit
    return out


@njit(cache=True)
def _cylinder(o: np.ndarray, d: np.ndarray, shape: np.ndarray, radius: float) -> float:
    """Length of the ray o + t d, |d| = 1, within a finite cylinder."""
    along, slope, dot, o2 = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        g = o[a] - shape[a]
        along += g * shape[3 + a]
        slope += d[a] * shape[3 + a]
        dot += g * d[a]
        o2 += g * g
    a2 = 1.0 - slope * slope
    b = dot - along * slope
    c = o2 - along * along - radius * radius
    near, far = -1e9, 1e9
    if a2 > 1e-12:
        disc = b * b - a2 * c
        if disc <= 0.0:
            return 0.0
        near, far = (-b - np.sqrt(disc)) / a2, (-b + np.sqrt(disc)) / a2
    elif c > 0.0:
        return 0.0
    half = shape[8]
    if abs(slope) > 1e-12:
        t0, t1 = (-half - along) / slope, (half - along) / slope
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    elif abs(along) > half:
        return 0.0
    return max(far - near, 0.0)


@njit(cache=True)
def chord(o: np.ndarray, d: np.ndarray, shape: np.ndarray) -> float:
    """Length, mm, of the ray o + t d, |d| = 1, within one packed solid (`things.pack`)."""
    if shape[8] >= 0.0:
        outer = _cylinder(o, d, shape, shape[6])
        return outer - _cylinder(o, d, shape, shape[7]) if shape[7] > 0.0 and outer > 0.0 else outer
    b, g2 = 0.0, 0.0
    for a in range(3):
        g = shape[a] - o[a]
        b += g * d[a]
        g2 += g * g
    left = shape[6] * shape[6] - (g2 - b * b)
    return 2.0 * np.sqrt(left) if left > 0.0 else 0.0


@njit(cache=True, parallel=True)
def solid_transmission(
    rays: Rays,
    spot: np.ndarray,
    cells: tuple[np.ndarray, np.ndarray],
    solids: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """(3, H, W): what sharp solids leave of each energy, averaged over SUB x SUB rays of each pixel.

    Each sub-ray starts elsewhere on the square focal spot: `spot` (2, 3) spans it. The offset on the spot is that in
    the pixel turned by 90°, so both blurs have their right size and neither leans on the other. `cells` (start, index):
    which solids may touch each cell of CELL_PX pixels; `solids`: shapes (M, 9) and attenuation (M, 3).
    """
    focal, points, inside = rays
    first, index = cells
    shapes, excess = solids
    h, w = inside.shape
    wide = (w + CELL_PX - 1) // CELL_PX
    out = np.ones((3, h, w), dtype=np.float32)
    for r in prange(1, h - 1):
        o, d, depth = np.empty(3), np.empty(3), np.empty(3)
        for c in range(1, w - 1):
            cell = (r // CELL_PX) * wide + c // CELL_PX
            if not inside[r, c] or first[cell] == first[cell + 1]:
                continue
            total = np.zeros(3)
            for s in range(SUB * SUB):
                pu, pv = (s % SUB + 0.5) / SUB - 0.5, (s // SUB + 0.5) / SUB - 0.5
                norm = 0.0
                for a in range(3):
                    o[a] = focal[a] + pv * spot[0, a] - pu * spot[1, a]
                    by_u = 0.5 * (points[r, c + 1, a] - points[r, c - 1, a])
                    by_v = 0.5 * (points[r + 1, c, a] - points[r - 1, c, a])
                    d[a] = points[r, c, a] + pu * by_u + pv * by_v - o[a]
                    norm += d[a] * d[a]
                d /= np.sqrt(norm)
                depth[:] = 0.0
                for n in range(first[cell], first[cell + 1]):
                    length = chord(o, d, shapes[index[n]])
                    if length > 0.0:
                        for e in range(3):
                            depth[e] += length * excess[index[n], e]
                for e in range(3):
                    total[e] += np.exp(-depth[e])
            for e in range(3):
                out[e, r, c] = total[e] / (SUB * SUB)
    return out


@njit(cache=True, parallel=True)
def box_length(rays: Rays, centres: np.ndarray, axes: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """(H, W) mm: length of each ray within cuboids: centres (M, 3), axes (M, 3, 3), half-lengths (M, 3)."""
    focal, _, inside = rays
    h, w = inside.shape
    out = np.zeros((h, w), dtype=np.float32)
    for r in prange(h):
        d = np.empty(3)
        for c in range(w):
            if not inside[r, c]:
                continue
            norm = _towards(rays, r, c, d)
            for m in range(len(centres)):
                span = (0.0, 1.0)
                for a in range(3):
                    start, slope = 0.0, 0.0
                    for b in range(3):
                        start += (focal[b] - centres[m, b]) * axes[m, a, b]
                        slope += d[b] * axes[m, a, b]
                    span = _within(span, start, slope, -halves[m, a], halves[m, a])
                near, far = span
                if far > near:
                    out[r, c] += (far - near) * norm
    return out
