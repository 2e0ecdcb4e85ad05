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


@njit(cache=True, parallel=True)
def volume_integral(rays: Rays, values: np.ndarray, origin: np.ndarray, voxel: float) -> np.ndarray:
    """(H, W) mm: integral of a volume along each ray, trilinear, one sample per voxel length. 0 where not inside.

    `values` (nx, ny, nz), value [i, j, k] at origin + voxel (i, j, k); zero at its faces.
    """
    focal, points, inside = rays
    h, w = inside.shape
    out = np.zeros((h, w), dtype=np.float32)
    top = np.array([values.shape[0] - 1.001, values.shape[1] - 1.001, values.shape[2] - 1.001])
    start = (focal - origin) / voxel
    for r in prange(h):
        d = np.empty(3)
        for c in range(w):
            if not inside[r, c]:
                continue
            norm = 0.0
            for a in range(3):
                d[a] = points[r, c, a] - focal[a]
                norm += d[a] * d[a]
            norm = np.sqrt(norm)
            near, far = 0.0, norm / voxel
            for a in range(3):
                d[a] /= norm
                if abs(d[a]) < 1e-12:
                    if start[a] < 0.0 or start[a] > top[a]:
                        far = -1.0
                    continue
                t0, t1 = -start[a] / d[a], (top[a] - start[a]) / d[a]
                near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
            if far <= near:
                continue
            steps = int(far - near) + 1
            step = (far - near) / steps
            total = 0.0
            for s in range(steps):
                t = near + (s + 0.5) * step
                x, y, z = start[0] + t * d[0], start[1] + t * d[1], start[2] + t * d[2]
                i, j, k = int(x), int(y), int(z)
                fx, fy, fz = x - i, y - j, z - k
                low = (1 - fy) * values[i, j, k] + fy * values[i, j + 1, k]
                low_up = (1 - fy) * values[i, j, k + 1] + fy * values[i, j + 1, k + 1]
                high = (1 - fy) * values[i + 1, j, k] + fy * values[i + 1, j + 1, k]
                high_up = (1 - fy) * values[i + 1, j, k + 1] + fy * values[i + 1, j + 1, k + 1]
                total += (1 - fx) * ((1 - fz) * low + fz * low_up) + fx * ((1 - fz) * high + fz * high_up)
            out[r, c] = total * step * voxel
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
    focal, points, inside = rays
    h, w = inside.shape
    out = np.zeros((h, w), dtype=np.float32)
    for r in prange(h):
        d = np.empty(3)
        for c in range(w):
            if not inside[r, c]:
                continue
            norm = 0.0
            for a in range(3):
                d[a] = points[r, c, a] - focal[a]
                norm += d[a] * d[a]
            norm = np.sqrt(norm)
            for m in range(len(centres)):
                near, far = 0.0, 1.0
                for a in range(3):
                    start, slope = 0.0, 0.0
                    for b in range(3):
                        start += (focal[b] - centres[m, b]) * axes[m, a, b]
                        slope += d[b] * axes[m, a, b]
                    if abs(slope) < 1e-12:
                        if abs(start) > halves[m, a]:
                            far = -1.0
                        continue
                    t0, t1 = (-halves[m, a] - start) / slope, (halves[m, a] - start) / slope
                    near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
                if far > near:
                    out[r, c] += (far - near) * norm
    return out
