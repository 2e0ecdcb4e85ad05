"""The planned wire as a check image should show it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.bead_view import bead_shadows_px
from sightline.calibration.view import CalibratedView
from sightline.errors import OutsideRegionError
from sightline.planning.bone.directions import unit
from sightline.planning.nail.result import Hole

BEFORE_MM, BEYOND_MM = 25.0, 15.0  # lengths added outside the entry and beyond the planned depth [ours]
GUIDED_MM = 80.0  # the same outside the entry for a wire that waits in its guide [ours]
_STEP_MM = 1.0
_STILL = RigidTransform.identity()
_NAIL_MM = 30.0  # of a nail to either side of its hole [ours]
_BESIDE_NAIL_MM = 2.0  # the bone may move so far between plan and check [ours]


@dataclass(frozen=True, eq=False)
class ExpectedWire:
    """M points of the planned axis in an image, from outside the entry to beyond the tip.

    `uv_px` (M, 2), IDCS; `along_mm` (M,): distance from the entry; `px_per_mm` (M,): scale across the wire at its
    depth; `sine` (M,): sine of the angle between wire and rays. `beads_px` (K, 3): centre and radius of the shadows of
    the frame's beads.
    """

    uv_px: np.ndarray
    along_mm: np.ndarray
    px_per_mm: np.ndarray
    sine: np.ndarray
    beads_px: np.ndarray


def nail_px(view: CalibratedView, hole: Hole, movement: RigidTransform = _STILL) -> np.ndarray:
    """Return a polygon (M, 2), IDCS, around the nail near one of its holes, as far as the view is calibrated.

    `movement`: from the CFCS of the hole to that of the view.
    """
    half = hole.nail.diameter_mm / 2 + _BESIDE_NAIL_MM
    nail_mm, along = movement.apply(hole.nail_mm), movement.rotation.apply(hole.nail_direction)
    sideways = unit(np.cross(along, nail_mm - view.focal_point_mm))
    ahead = np.linspace(-_NAIL_MM, _NAIL_MM, 31)[:, None] * along
    return view.project_seen(nail_mm + np.concatenate([ahead + half * sideways, ahead[::-1] - half * sideways]))[0]


def expected_wire(
    view: CalibratedView, ends_mm: np.ndarray, drilled_beyond_mm: float = 0.0, before_mm: float = BEFORE_MM
) -> ExpectedWire:
    """Return a wire planned from entry to end (2, 3) in a view, from `before_mm` outside the entry to
    `drilled_beyond_mm` past its end point, as far as the view is calibrated.

    Raises OutsideRegionError where no part of it lies in the calibrated region.
    """
    entry, end = ends_mm
    length = float(np.linalg.norm(end - entry))
    direction = (end - entry) / length
    along = np.arange(-before_mm, length + drilled_beyond_mm + BEYOND_MM, _STEP_MM)
    xyz = entry + along[:, None] * direction
    rays = xyz - view.focal_point_mm
    across = np.cross(direction, rays)
    sine = np.linalg.norm(across, axis=1) / np.linalg.norm(rays, axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    edged = np.stack([xyz, xyz - across / 2, xyz + across / 2], axis=1)
    pixels, visible = view.project_seen(edged.reshape(-1, 3))
    seen = np.full((edged.size // 3, 2), np.nan)
    seen[visible] = pixels
    seen = seen.reshape(-1, 3, 2)
    inside = visible.reshape(-1, 3).all(axis=1)
    if np.count_nonzero(inside) < 2:
        raise OutsideRegionError(
            f"no part of the plan lies in the calibrated region of view {view.name!r}; move the frame so that its "
            "beads surround it"
        )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int))).reshape(-1, 2)
    first, last = edges[np.argmax(np.diff(edges, axis=1))]
    uv = seen[first:last]
    scale = np.linalg.norm(uv[:, 2] - uv[:, 1], axis=1)
    return ExpectedWire(uv[:, 0], along[first:last], scale, sine[first:last], bead_shadows_px(view))
