"""Lengths and angles between clicks in one image: in a plane through a known point, parallel to the view's plate."""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import UnusableInputError
from sightline.geometry.covariance import TWO_SIDED_95, response
from sightline.planning.picks import DEFAULT_PICK_SD_PX


@dataclass(frozen=True)
class Measured:
    """A length, mm, between two clicks, or an angle, rad, at the second of three; only of what lies in the plane.

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
    if (np.linalg.norm(np.diff(uv, axis=0), axis=1) < 1.0).any():
        raise UnusableInputError("click two places that are at least one pixel apart")
    lines = view.lines_of_sight(uv)
    plane = lines.plane
    normal = np.cross(*plane.axes)

    def value(of: np.ndarray) -> np.ndarray:
        focal = of[:, None, :3]
        ray = plane.origin_mm + of[:, 3:].reshape(len(of), -1, 2) @ plane.axes - focal
        points = focal + ray * (((at_mm - focal) @ normal) / (ray @ normal))[..., None]
        sides = points[:, 1:] - points[:, :1] if len(uv) == 2 else points[:, ::2] - points[:, 1:2]
        if len(uv) == 2:
            return np.linalg.norm(sides[:, 0], axis=1, keepdims=True)
        across = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1, keepdims=True)
        return np.arctan2(across, (sides[:, 0] * sides[:, 1]).sum(axis=1, keepdims=True))

    (found,), by = response(value, np.concatenate([lines.focal_point_mm, lines.xy_mm.ravel()]))
    per_mm = float(1.0 / abs((lines.focal_point_mm - at_mm) @ normal)) if len(uv) == 2 else 0.0
    if lines.covariance is None:
        return Measured(float(found), None, per_mm)
    covariance = np.array(sum(lines.covariance.values()))
    for k, jacobian in enumerate(lines.jacobian):
        covariance[3 + 2 * k : 5 + 2 * k, 3 + 2 * k : 5 + 2 * k] += pick_sd_px**2 * jacobian @ jacobian.T
    sd = float(np.sqrt((by @ covariance @ by.T)[0, 0]))
    return Measured(float(found), TWO_SIDED_95 * sd, per_mm)
