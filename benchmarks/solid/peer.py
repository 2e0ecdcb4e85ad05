"""A peer of the joint adjustment: DLT and bundle adjustment of each view, as XMALab calibrates with its cube.

The positions of the balls count as exact, and nothing is known of the C-arm.
"""

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sightline.studies.scenes import TargetScene


def located_by_dlt(scene: TargetScene, uv_px: np.ndarray) -> np.ndarray:
    """Return the points (T, 3), CFCS, of target pixels (2, T, 2)."""
    first, second = (_bundled(_dlt(*balls), *balls) for balls in _balls(scene))
    homogeneous = cv2.triangulatePoints(first, second, uv_px[0].T, uv_px[1].T)
    return (homogeneous[:3] / homogeneous[3]).T


def _balls(scene: TargetScene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each view the measured pixels (N, 2) and the nominal positions (N, 3) of the balls."""
    known = scene.frame.xyz_mm_by_id
    return [(seen.uv_px, np.array([known[i] for i in seen.ids])) for seen in scene.observations.values()]


def _dlt(uv_px: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the projection matrix (3, 4) by the direct linear transformation of normalised coordinates."""
    (to_uv, uv), (to_xyz, xyz) = (_normalised(points) for points in (uv_px, xyz_mm))
    zero = np.zeros_like(xyz)
    rows = np.concatenate([np.hstack([xyz, zero, -uv[:, :1] * xyz]), np.hstack([zero, xyz, -uv[:, 1:2] * xyz])])
    return np.linalg.inv(to_uv) @ np.linalg.svd(rows)[2][-1].reshape(3, 4) @ to_xyz


def _normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix that centres and scales points (N, D), and the points as (N, D + 1)."""
    size = points.shape[1]
    matrix = np.eye(size + 1)
    matrix[:size] /= np.std(points)
    matrix[:size, size] = -points.mean(axis=0) / np.std(points)
    return matrix, np.column_stack([points, np.ones(len(points))]) @ matrix.T


def _bundled(matrix: np.ndarray, uv_px: np.ndarray, xyz_mm: np.ndarray) -> np.ndarray:
    """Return the projection matrix with the least reprojection error over pose, two focal lengths, principal point."""
    if np.linalg.det(matrix[:, :3]) < 0:
        matrix = -matrix
    inner, rotation = cv2.RQDecomp3x3(matrix[:, :3])[1:3]
    shift = np.linalg.solve(inner, matrix[:, 3])
    inner = inner / inner[2, 2]
    start = np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift, inner[[0, 1, 0, 1], [0, 1, 2, 2]]])

    def projection(unknowns: np.ndarray) -> np.ndarray:
        inner = np.array([[unknowns[6], 0.0, unknowns[8]], [0.0, unknowns[7], unknowns[9]], [0.0, 0.0, 1.0]])
        return inner @ np.column_stack([Rotation.from_rotvec(unknowns[:3]).as_matrix(), unknowns[3:6]])

    def residuals(unknowns: np.ndarray) -> np.ndarray:
        image = np.column_stack([xyz_mm, np.ones(len(xyz_mm))]) @ projection(unknowns).T
        return (image[:, :2] / image[:, 2:] - uv_px).ravel()

    return projection(least_squares(residuals, start, x_scale="jac").x)
