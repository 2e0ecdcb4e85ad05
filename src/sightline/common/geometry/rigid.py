"""Rigid motions: least-squares fits of point sets, and small motions (twists).

A twist is (rotation vector rad, translation mm), the order of `RigidTransform.from_exp_coords`. Spatial twists are
expressed in the coordinates that a pose maps to: a pose T moved by the twist x is exp(x) T.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

ROTATION_TOLERANCE = 1e-4  # [ours] 0.025 mm over a wire of 250 mm; rounding to 32 bits gives 2e-7


def rigid_fit(from_mm: np.ndarray, to_mm: np.ndarray) -> "RigidTransform":
    """Return the least-squares pose: to_mm = pose.apply(from_mm), (N, 3) each."""
    from scipy.spatial.transform import RigidTransform, Rotation  # here: it takes 6 MB, and no view of plates needs it

    rotation, translation = rigid_fits(from_mm[None], to_mm[None])
    return RigidTransform.from_components(translation[0], Rotation.from_matrix(rotation[0]))


def rigid_fits(from_mm: np.ndarray, to_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return least-squares rotations (T, 3, 3) and translations (T, 3) of T point sets (T, N, 3): Kabsch's method."""
    p, q = from_mm.mean(axis=1), to_mm.mean(axis=1)
    u, _, vt = np.linalg.svd(np.einsum("tni,tnj->tij", to_mm - q[:, None], from_mm - p[:, None]))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotation = u @ vt
    return rotation, q - np.einsum("tij,tj->ti", rotation, p)


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrix (..., 3, 3) whose product with w is `vector` x w."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def adjoint(pose: "RigidTransform") -> np.ndarray:
    """Return the adjoint (..., 6, 6) of `pose`, which transforms twists: exp(adjoint(T) x) = T exp(x) T⁻¹."""
    rotation = pose.rotation.as_matrix()
    matrix = np.zeros((*rotation.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., 3:, :3] = cross_matrix(pose.translation) @ rotation
    return matrix


def displacement(xyz_mm: np.ndarray) -> np.ndarray:
    """Return the derivative (..., 3, 6) of points (..., 3) by a small spatial twist."""
    xyz = np.asarray(xyz_mm, dtype=np.float64)
    return np.concatenate([-cross_matrix(xyz), np.broadcast_to(np.eye(3), (*xyz.shape, 3))], axis=-1)


def why_not_rigid(matrix: np.ndarray) -> str | None:
    """Return None for a rigid (4, 4) matrix, else what is wrong with it."""
    if not np.isfinite(matrix).all():
        return "it holds numbers that are not finite"
    if matrix[3].tolist() != [0, 0, 0, 1]:
        return "its last row is not 0 0 0 1"
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > ROTATION_TOLERANCE:
        return f"its axes are not orthonormal: off by {off:.2g}"
    if np.linalg.det(rotation) < 0:
        return "its axes are left-handed"
    return None


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) spread evenly over the sphere."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=-1)
