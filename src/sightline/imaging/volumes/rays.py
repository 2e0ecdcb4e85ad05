"""The rays of an image, and integrals of volumes along them, in compiled kernels whose threads share the rows."""

from typing import NamedTuple

import numpy as np

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts


class Rays(NamedTuple):
    """The rays of an image, CFCS: from `focal` (3,) to `points` (H, W, 3) on the input plane; cast where `inside`."""

    focal: np.ndarray
    points: np.ndarray
    inside: np.ndarray


@kernel()
def towards(rays: Rays, r: int, c: int, d: np.ndarray) -> float:
    """Fill `d` (3,) with the vector from the focal point to one pixel's point on the input plane; return its length."""
    norm = 0.0
    for a in range(3):
        d[a] = rays.points[r, c, a] - rays.focal[a]
        norm += d[a] * d[a]
    return np.sqrt(norm)


@kernel()
def within(span: tuple[float, float], start: float, slope: float, low: float, high: float) -> tuple[float, float]:
    """Return the part (near, far) of a span of t where low <= start + t slope <= high; far < near: none."""
    near, far = span
    if abs(slope) < 1e-12:
        return (near, far) if low <= start <= high else (0.0, -1.0)
    t0, t1 = (low - start) / slope, (high - start) / slope
    return max(near, min(t0, t1)), min(far, max(t0, t1))


def volume_integral(rays: Rays, values: np.ndarray, origin: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    """Return the integrals (H, W), mm, of a volume along the rays, with trilinear interpolation and one sample per
    shortest voxel edge; 0 where not inside.

    `values` (nx, ny, nz), C-contiguous: value [i, j, k] at origin + voxel * (i, j, k), 0 beyond them. `voxel` (3,) mm.
    At least two voxels per side.
    """
    lengths = np.zeros(rays.inside.shape, dtype=np.float32)
    unit = voxel[0]
    ratio = unit / voxel
    in_parts(
        _cast_volume, rays, values.ravel(), values.shape, (rays.focal - origin) / unit * ratio, ratio, unit, lengths
    )
    return lengths


# Reassociation lets the compiler take eight samples at a time; the float32 results stay bit-identical.
@kernel(nogil=True, fastmath=True)
def _cast_volume(part, parts, rays, flat, shape, start, ratio, unit, lengths):  # noqa: PLR0917
    """Voxels `flat` (n,) of `shape`; `start` (3,) the focal point in voxels, `ratio` (3,) voxels per `unit` mm."""
    h, w = rays.inside.shape
    ni, nj = shape[1] * shape[2], shape[2]
    most = max(ratio[0], ratio[1], ratio[2])
    d = np.empty(3)
    for r in range(part, h, parts):
        for c in range(w):
            if not rays.inside[r, c]:
                continue
            norm = towards(rays, r, c, d)
            span = (0.0, norm / unit)
            for a in range(3):
                d[a] = d[a] / norm * ratio[a]
                span = within(span, start[a], d[a], 0.0, shape[a] - 1.001)
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
                at = i * ni + j * nj + k  # unsigned below, so that numba tests no index for being negative
                a00, a01 = np.uint64(at), np.uint64(at + nj)
                a10, a11 = np.uint64(at + ni), np.uint64(at + ni + nj)
                up = np.uint64(1)
                low = (1 - fy) * flat[a00] + fy * flat[a01]
                low_up = (1 - fy) * flat[a00 + up] + fy * flat[a01 + up]
                high = (1 - fy) * flat[a10] + fy * flat[a11]
                high_up = (1 - fy) * flat[a10 + up] + fy * flat[a11 + up]
                total += (1 - fx) * ((1 - fz) * low + fz * low_up) + fx * ((1 - fz) * high + fz * high_up)
            lengths[r, c] = total * step * unit
