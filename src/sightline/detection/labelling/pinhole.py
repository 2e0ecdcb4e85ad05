"""A pinhole camera with square pixels and its least-squares fit to balls, fast enough to try many.

Labelling tries hypotheses with it; a solid is calibrated with the camera of `calibration.solids.panel_camera`.
"""

from typing import NamedTuple

import numpy as np

from sightline.common.kernels import kernel

STEPS = 4  # Gauss-Newton steps of a fit; from a hypothesis three suffice for 0.01 px [calc]
PARAMETERS = 9


class Prior(NamedTuple):
    """Priors of a camera: log focal length (px) with its s.d., principal point (2,), px, with its s.d. per axis."""

    log_focal: float
    log_focal_sd: float
    principal_px: np.ndarray
    principal_sd_px: float


class Camera(NamedTuple):
    """A pinhole camera with square pixels, seen from a point in the middle of the balls.

    `matrix` (3, 3) rotates the balls' axes into right, down and along the beam. `numbers` (6,): pixel u, v of the
    point `middle_mm` (3,), log px/mm there, log focal length (px), principal point u, v.
    """

    matrix: np.ndarray
    middle_mm: np.ndarray
    numbers: np.ndarray


class Fit(NamedTuple):
    """A camera fitted to balls, see `fit`."""

    camera: Camera
    precision: np.ndarray
    chi2: float
    half_log_det: float


@kernel()
def project(camera, xyz_mm):
    """Return pixels (N, 2) of points (N, 3), px/mm (N,) there, and the derivatives (N, 2, 9) of the pixels.

    Parameters: rotation vector (camera axes), then the camera's `numbers`.
    """
    u0, v0, log_scale, log_focal, pu, pv = camera.numbers
    scale, focal = np.exp(log_scale), np.exp(log_focal)
    n = len(xyz_mm)
    uv, scales, by = np.empty((n, 2)), np.empty(n), np.zeros((n, 2, PARAMETERS))
    for k in range(n):
        x, y, z = scale * (camera.matrix @ (xyz_mm[k] - camera.middle_mm))
        depth = 1 + z / focal
        scales[k] = scale / depth
        for axis in range(2):
            q = ((u0 - pu + x) if axis == 0 else (v0 - pv + y)) / depth
            uv[k, axis] = q + camera.numbers[4 + axis]
            by_x, by_y, by_z = (1.0 - axis) / depth, axis / depth, -q / focal / depth
            row = by[k, axis]
            row[0], row[1], row[2] = y * by_z - z * by_y, z * by_x - x * by_z, x * by_y - y * by_x
            row[3 + axis] = 1 / depth
            row[5] = x * by_x + y * by_y + z * by_z
            row[6] = -by_z * z
            row[7 + axis] = 1 - 1 / depth
    return uv, scales, by


@kernel()
def _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2):
    """Return the precision (9, 9), the gradient (9,), chi-square, and half the log determinants of the covariances."""
    uv, _, by = project(camera, xyz_mm)
    precision, gradient, chi2, half_log_det = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0, 0.0
    for k in range(len(xyz_mm)):
        a, b, c = variance_px2[k, 0, 0], variance_px2[k, 0, 1], variance_px2[k, 1, 1]
        determinant = a * c - b * b
        half_log_det += 0.5 * np.log(determinant)
        off_u, off_v = uv_px[k, 0] - uv[k, 0], uv_px[k, 1] - uv[k, 1]
        du, dv = (c * off_u - b * off_v) / determinant, (a * off_v - b * off_u) / determinant
        chi2 += du * off_u + dv * off_v
        for i in range(PARAMETERS):
            ju, jv = by[k, 0, i], by[k, 1, i]
            wu, wv = (c * ju - b * jv) / determinant, (a * jv - b * ju) / determinant
            gradient[i] += ju * du + jv * dv
            for j in range(i + 1):
                precision[i, j] += wu * by[k, 0, j] + wv * by[k, 1, j]
    for i in range(PARAMETERS):
        for j in range(i):
            precision[j, i] = precision[i, j]
    for i in range(3):
        weight = (prior.log_focal_sd if i == 0 else prior.principal_sd_px) ** -2
        away = (prior.log_focal if i == 0 else prior.principal_px[i - 1]) - camera.numbers[3 + i]
        precision[6 + i, 6 + i] += weight
        gradient[6 + i] += weight * away
        chi2 += weight * away**2
    return precision, gradient, chi2, half_log_det


@kernel()
def _rotated(matrix, vector):
    """Return the rotation by a small rotation vector, to second order and made orthonormal again, of a matrix."""
    out = np.empty((3, 3))
    for c in range(3):
        column = matrix[:, c]
        first = np.cross(vector, column)
        out[:, c] = column + first + 0.5 * np.cross(vector, first)
    x = out[0] / np.sqrt(out[0] @ out[0])
    y = out[1] - (out[1] @ x) * x
    y /= np.sqrt(y @ y)
    out[0], out[1], out[2] = x, y, np.cross(x, y)
    return out


@kernel()
def fit(camera, prior, xyz_mm, uv_px, variance_px2):
    """Return the least-squares camera for balls (n, 3) seen at pixels (n, 2) with covariances (n, 2, 2).

    With it: the precision (9, 9) of its parameters, chi-square with the priors' share, and half the sum of the log
    determinants of the covariances.
    """
    precision, gradient, chi2, half_log_det = _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2)
    for _ in range(STEPS):
        step = np.linalg.solve(precision, gradient)
        camera = Camera(_rotated(camera.matrix, step[:3]), camera.middle_mm, camera.numbers + step[3:])
        precision, gradient, chi2, half_log_det = _normal_equations(camera, prior, xyz_mm, uv_px, variance_px2)
    return Fit(camera, precision, chi2, half_log_det)
