"""Radiographs of a volume and their derivatives by its pose: both come from one pass along the rays.

The integral of attenuation along a ray changes with the pose only through the gradient g along it: of a rotation
vector w about c and a shift v, the change is -w·[(f - c) x ∫g + d x ∫t g] - v·∫g, with the ray's points at f + t d.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.imaging.volumes.volume import Volume


class RayBundle(NamedTuple):
    """N rays, CFCS: from `focal` (3,) in directions `along` (N, 3), unit vectors."""

    focal: np.ndarray
    along: np.ndarray


def shadow(rays: RayBundle, volume: Volume, pose: RigidTransform) -> np.ndarray:
    """Return the integrals (N,) of a volume, whose coordinates `pose` takes to CFCS, along rays."""
    return _integrals(rays, volume, pose)[:, 0]


def shadow_and_derivatives(
    rays: RayBundle, volume: Volume, pose: RigidTransform, centre_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return `shadow`, and its derivatives (N, 6) by a rotation vector about `centre_mm` (3,), CFCS, and a shift."""
    sums = _integrals(rays, volume, pose)
    from_index = (volume.axes / volume.voxel_mm[:, None]).T
    turn = pose.rotation.as_matrix() @ from_index
    once, by_distance = sums[:, 1:4] @ turn.T, sums[:, 4:] @ turn.T
    moment = np.cross(rays.focal - centre_mm, once) + np.cross(rays.along, by_distance)
    return sums[:, 0], -np.concatenate([moment, once], axis=1)


def _integrals(rays: RayBundle, volume: Volume, pose: RigidTransform) -> np.ndarray:
    """Return the integrals (N, 7) of value, gradient and distance times gradient; gradients by the volume's indices."""
    back = pose.inv()
    start = volume.axes @ (back.apply(rays.focal) - volume.origin_mm) / volume.voxel_mm
    along = rays.along @ back.rotation.as_matrix().T @ volume.axes.T / volume.voxel_mm
    sums = np.zeros((len(along), 7))
    values = volume.values
    in_parts(_cast, values.ravel(), values.shape, start, along, float(volume.voxel_mm.min()), sums)
    return sums


@kernel(nogil=True, fastmath=True)
def _cast(part, parts, flat, shape, start, along, step_mm, sums):  # noqa: PLR0917
    """Add up samples at most `step_mm` apart; `start` (3,) and `along` (N, 3) in indices, per mm."""
    ni, nj = shape[1] * shape[2], shape[2]
    for n in range(part, len(along), parts):
        near, far = 0.0, 1e9
        for a in range(3):
            slope, first = along[n, a], start[a]
            last = shape[a] - 1.001
            if slope * slope < 1e-24:
                if first < 0.0 or first > last:
                    far = -1.0
            else:
                t0, t1 = -first / slope, (last - first) / slope
                near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
        if far <= near:
            continue
        steps = int((far - near) / step_mm) + 1
        step = (far - near) / steps
        dx, dy, dz = along[n, 0], along[n, 1], along[n, 2]
        value, gx, gy, gz, tx, ty, tz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for s in range(steps):
            t = near + (s + 0.5) * step
            x, y, z = start[0] + t * dx, start[1] + t * dy, start[2] + t * dz
            i, j, k = np.int32(x), np.int32(y), np.int32(z)
            fx, fy, fz = x - i, y - j, z - k
            at = i * ni + j * nj + k  # unsigned below, so that numba tests no index for being negative
            a000, a010 = flat[np.uint64(at)], flat[np.uint64(at + nj)]
            a100, a110 = flat[np.uint64(at + ni)], flat[np.uint64(at + ni + nj)]
            a001, a011 = flat[np.uint64(at + 1)], flat[np.uint64(at + nj + 1)]
            a101, a111 = flat[np.uint64(at + ni + 1)], flat[np.uint64(at + ni + nj + 1)]
            b00, b01 = a000 + fz * (a001 - a000), a010 + fz * (a011 - a010)
            b10, b11 = a100 + fz * (a101 - a100), a110 + fz * (a111 - a110)
            c0, c1 = b00 + fy * (b01 - b00), b10 + fy * (b11 - b10)
            value += c0 + fx * (c1 - c0)
            hx = c1 - c0
            hy = (1 - fx) * (b01 - b00) + fx * (b11 - b10)
            hz = (1 - fx) * ((1 - fy) * (a001 - a000) + fy * (a011 - a010)) + fx * (
                (1 - fy) * (a101 - a100) + fy * (a111 - a110)
            )
            gx, gy, gz = gx + hx, gy + hy, gz + hz
            tx, ty, tz = tx + t * hx, ty + t * hy, tz + t * hz
        sums[n, 0], sums[n, 1], sums[n, 2], sums[n, 3] = value * step, gx * step, gy * step, gz * step
        sums[n, 4], sums[n, 5], sums[n, 6] = tx * step, ty * step, tz * step
