"""The planned wire in an image: its outline, and the 95 % band in which the drilled wire runs."""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.covariance import TWO_SIDED_95
from sightline.common.geometry.lines import cross
from sightline.errors import OutsideRegionError
from sightline.planning.points.trajectory import Trajectory

WIRE_DIAMETER_MM = 2.5  # physics.md, Planning figures [paper]
_STEP_MM = 5.0  # about 25 px: the chord of a distorted line then deviates from it by less than 0.06 px [ours]


@dataclass(frozen=True, eq=False)
class Corridor:
    """The planned wire in one view at S stations along it, as far as the view is calibrated.

    `along_mm` (S,): distance from the entry point; `uv_px` (S, 2): centre line and `across_px` (S, 2): unit vectors
    across it, IDCS; `px_per_mm` (S,): scale across it; `wire_half_px` (S,): half the wire's width. `half_95_px` (S,):
    half width of the band that holds the drilled wire with a probability of 95 %; None where
    `trajectory.error_stated` is False.
    """

    along_mm: np.ndarray
    uv_px: np.ndarray
    across_px: np.ndarray
    px_per_mm: np.ndarray
    wire_half_px: np.ndarray
    half_95_px: np.ndarray | None


def corridor(
    view: CalibratedView,
    trajectory: Trajectory,
    wire_mm: float = WIRE_DIAMETER_MM,
    beyond_mm: float = 0.0,
    robot_mm2: np.ndarray | None = None,
) -> Corridor:
    """Return the corridor of a trajectory, to `beyond_mm` past its end point; `wire_mm`: diameter of the wire.

    `robot_mm2` (6, 6), CFCS, of (entry, end): added to the plan's own covariance. The error of the point at fraction s
    of the length is (1 - s) times the entry's error plus s times the end's. Raises OutsideRegionError where no part of
    the wire lies in the view's calibrated region.
    """
    length = trajectory.length_mm
    along = np.linspace(0.0, length + beyond_mm, 2 + int((length + beyond_mm) / _STEP_MM))
    xyz = trajectory.entry_mm + along[:, None] * trajectory.direction
    sideways = cross(trajectory.direction, xyz - view.focal_point_mm)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    uv, seen = view.project_seen(np.concatenate([xyz, xyz - sideways / 2, xyz + sideways / 2]))
    whole = seen.reshape(3, -1).all(axis=0)
    pixels = np.zeros((len(seen), 2))
    pixels[seen] = uv
    middle, left, right = pixels.reshape(3, -1, 2)[:, whole]
    if len(middle) < 2:
        raise OutsideRegionError(
            f"no part of the plan lies in the calibrated region of view {view.name!r}; move the frame so that its "
            "beads surround it"
        )
    tangent = np.gradient(middle, along[whole], axis=0)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    px_per_mm = np.abs(np.einsum("ij,ij->i", across, right - left))
    half_95 = None
    if trajectory.error_stated:
        covariance = trajectory.covariance_mm2 if robot_mm2 is None else trajectory.covariance_mm2 + robot_mm2
        share = (along / length)[whole, None]
        response = np.hstack([(1.0 - share) * sideways[whole], share * sideways[whole]])
        half_95 = TWO_SIDED_95 * px_per_mm * np.sqrt(np.einsum("ip,pq,iq->i", response, covariance, response))
    return Corridor(along[whole], middle, across, px_per_mm, px_per_mm * wire_mm / 2, half_95)
