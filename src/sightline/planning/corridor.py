"""Where in an image the drilled wire will run: its outline, and how far from the line that was meant it may be."""

from dataclasses import dataclass

import numpy as np

from sightline.calibration.view import CalibratedView
from sightline.errors import OutsideRegionError
from sightline.geometry.covariance import TWO_SIDED_95
from sightline.planning.trajectory import Trajectory

WIRE_MM = 2.5  # diameter (physics.md, Planning figures) [paper]
_STEP_MM = 5.0  # about 25 px: the chord of a distorted line is then off by less than 0.06 px [ours]


@dataclass(frozen=True, eq=False)
class Corridor:
    """The planned wire in one view, S stations along it, as far as the view sees it.

    `along_mm` (S,) from the entry point; `uv_px` (S, 2) its middle, `across_px` (S, 2) unit vectors across, IDCS;
    `wire_half_px` (S,): half its width; `half_95_px` (S,): at each station the drilled wire runs within this of the
    line that was meant, seen in this image, with a probability of 95 %; None where `trajectory.error_stated` is False.
    """

    along_mm: np.ndarray
    uv_px: np.ndarray
    across_px: np.ndarray
    wire_half_px: np.ndarray
    half_95_px: np.ndarray | None


def corridor(
    view: CalibratedView,
    trajectory: Trajectory,
    wire_mm: float = WIRE_MM,
    beyond_mm: float = 0.0,
    robot_mm2: np.ndarray | None = None,
) -> Corridor:
    """The corridor of a trajectory, to `beyond_mm` past its end point; `wire_mm` is a diameter.

    `robot_mm2` (6, 6), CFCS, of (entry, end): added to the plan's own covariance. The point at s of the way errs by
    (1 - s) times the entry's error and s times the end's. Raises OutsideRegionError where the view sees none of it.
    """
    length = trajectory.length_mm
    along = np.linspace(0.0, length + beyond_mm, 2 + int((length + beyond_mm) / _STEP_MM))
    xyz = trajectory.entry_mm + along[:, None] * trajectory.direction
    sideways = np.cross(trajectory.direction, xyz - view.focal_point_mm)
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    uv, seen = view.project_seen(np.concatenate([xyz, xyz - sideways / 2, xyz + sideways / 2]))
    whole = seen.reshape(3, -1).all(axis=0)
    pixels = np.zeros((len(seen), 2))
    pixels[seen] = uv
    middle, left, right = pixels.reshape(3, -1, 2)[:, whole]
    if len(middle) < 2:
        raise OutsideRegionError(
            f"view {view.name!r} is calibrated nowhere along the plan; move the frame so that its beads surround it"
        )
    tangent = np.gradient(middle, along[whole], axis=0)
    across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    px_per_mm = np.abs(np.einsum("ij,ij->i", across, right - left))
    half_95 = None
    if trajectory.error_stated:
        covariance = trajectory.covariance_mm2 if robot_mm2 is None else trajectory.covariance_mm2 + robot_mm2
        share = (along / length)[whole, None]
        errs = np.hstack([(1.0 - share) * sideways[whole], share * sideways[whole]])
        half_95 = TWO_SIDED_95 * px_per_mm * np.sqrt(np.einsum("ip,pq,iq->i", errs, covariance, errs))
    return Corridor(along[whole], middle, across, px_per_mm * wire_mm / 2, half_95)
