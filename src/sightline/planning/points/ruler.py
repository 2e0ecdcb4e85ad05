"""Lengths and angles between clicks: in space where two images show them; in one image in a plane through a known
point, parallel to the view's plate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.covariance import TWO_SIDED_95, response
from sightline.errors import UnusableInputError
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX
from sightline.planning.points.reconstruct import reconstruct


@dataclass(frozen=True)
class Measured:
    """A length, mm, between two clicks, or an angle, rad, at the second of three; in one image only of what lies in the
    plane.

    `error_95`: its 95 % error from picks and calibration, None where that is unknown. `per_mm`: share by which a length
    changes for each mm that what was clicked lies before or behind the plane; an angle between lines parallel to the
    plane does not.
    """

    value: float
    error_95: float | None
    per_mm: float


def measured_in_plane(
    view: CalibratedView, uv_px: np.ndarray, at_mm: np.ndarray, pick_sd_px: float = DEFAULT_PICK_SD_PX
) -> Measured:
    """Return the length between two pixels (2, 2), or the angle at the second of three (3, 2), in the plane through
    `at_mm` (3,). Raises OutsideRegionError, and UnusableInputError for pixels in one place."""
    uv = np.asarray(uv_px, dtype=np.float64)
    _refuse_one_place(uv)
    lines = view.lines_of_sight(uv)
    plane = lines.plane
    normal = np.cross(*plane.axes)

    def value(of: np.ndarray) -> np.ndarray:
        focal = of[:, None, :3]
        ray = plane.origin_mm + of[:, 3:].reshape(len(of), -1, 2) @ plane.axes - focal
        points = focal + ray * (((at_mm - focal) @ normal) / (ray @ normal))[..., None]
        return _size(points)

    (found,), by = response(value, np.concatenate([lines.focal_point_mm, lines.xy_mm.ravel()]))
    per_mm = float(1.0 / abs((lines.focal_point_mm - at_mm) @ normal)) if len(uv) == 2 else 0.0
    if lines.covariance is None:
        return Measured(float(found), None, per_mm)
    covariance = np.array(sum(lines.covariance.values()))
    for k, jacobian in enumerate(lines.jacobian):
        covariance[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] += pick_sd_px**2 * jacobian @ jacobian.T
    sd = float(np.sqrt((by @ covariance @ by.T)[0, 0]))
    return Measured(float(found), TWO_SIDED_95 * sd, per_mm)


def measured_in_space(
    views: Sequence[CalibratedView], uv_px: np.ndarray, pick_sd_px: float = DEFAULT_PICK_SD_PX
) -> Measured:
    """Return the length between two points that two views show at pixels (2, 2, 2), or the angle at the second of three
    (2, 3, 2): axes view, point, (u, v).

    Raises OutsideRegionError, ReconstructionRefusedError, and UnusableInputError for pixels in one place and where the
    lines of sight contradict each other: the clicks are not on the same points.
    """
    uv = np.asarray(uv_px, dtype=np.float64)
    for one in uv:
        _refuse_one_place(one)
    points = reconstruct(views, uv, np.broadcast_to(pick_sd_px**2 * np.eye(2), (*uv.shape, 2)))
    if points.gap_failed.any():
        raise UnusableInputError(
            f"lines of sight of the clicks pass each other at {np.max(points.gap_mm):.1f} mm; click the same places in "
            "both images, in the same order"
        )
    (found,), by = response(lambda of: _size(of.reshape(len(of), -1, 3)), points.xyz_mm.ravel())
    joint = points.joint_covariance_mm2
    error = None if joint is None else TWO_SIDED_95 * float(np.sqrt((by @ joint @ by.T)[0, 0]))
    return Measured(float(found), error, 0.0)


def _size(points: np.ndarray) -> np.ndarray:
    """Return the lengths between two points (K, 2, 3), or the angles at the second of three (K, 3, 3), as (K, 1)."""
    if points.shape[1] == 2:
        return np.linalg.norm(points[:, 1] - points[:, 0], axis=1, keepdims=True)
    one, other = points[:, 0] - points[:, 1], points[:, 2] - points[:, 1]
    across = np.linalg.norm(np.cross(one, other), axis=1, keepdims=True)
    return np.arctan2(across, (one * other).sum(axis=1, keepdims=True))


def _refuse_one_place(uv_px: np.ndarray) -> None:
    if (np.linalg.norm(np.diff(uv_px, axis=0), axis=1) < 1.0).any():
        raise UnusableInputError("click two places that are at least one pixel apart")
