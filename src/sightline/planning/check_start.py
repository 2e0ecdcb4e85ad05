"""What a check shot's adjustment begins with: what was picked and seen, and first values of what is sought."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration.view import CalibratedView
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.geometry.lines import nearest_approach
from sightline.planning.check_result import FEWEST_LANDMARKS
from sightline.planning.picks import DEFAULT_PICK_SD_PX
from sightline.planning.reconstruct import SMALLEST_ANGLE_RAD, reconstruct
from sightline.planning.trajectory import Trajectory

CURVE = 4  # terms of the wire's curve along either axis across it: its place, its direction, two of bending
_LEAST_COSINE = 0.8  # of wire and plan: beyond 37° it is another wire [ours]
_TIPS_APART_MM = 5.0  # seen in both views, a tip errs by 0.2 mm [ours]


class WireSeen(Protocol):
    """A wire found in one image, px; along the tangent a point of the centre line says nothing."""

    @property
    def uv_px(self) -> np.ndarray:
        """(N, 2) points of the centre line."""
        ...

    @property
    def variance_px2(self) -> np.ndarray:
        """(N,) across it."""
        ...

    @property
    def tip_uv_px(self) -> np.ndarray:
        """(2,)."""
        ...

    @property
    def tip_variance_px2(self) -> float:
        """Along it."""
        ...


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points of the bone picked in the planning images and found again in the check's, (2, N, 2) px each, N from 0.

    `sd_px`: of a pick, per axis. Raises UnusableInputError.
    """

    planned_uv_px: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 2)))
    checked_uv_px: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 2)))
    sd_px: float = DEFAULT_PICK_SD_PX

    def __post_init__(self) -> None:
        planned, checked = (np.asarray(uv, dtype=np.float64) for uv in (self.planned_uv_px, self.checked_uv_px))
        if planned.shape != checked.shape or planned.ndim != 3 or planned.shape[::2] != (2, 2):
            raise UnusableInputError(
                f"landmarks have the shapes {planned.shape} and {checked.shape}; (2, N, 2) was expected of both: the "
                "same points in both pairs of images"
            )
        if not (
            np.isfinite(planned).all() and np.isfinite(checked).all() and np.isfinite(self.sd_px) and self.sd_px > 0
        ):
            raise UnusableInputError("landmarks must be finite pixels, and their standard deviation positive")

    def __len__(self) -> int:
        return np.shape(self.planned_uv_px)[1]


@dataclass(frozen=True, eq=False)
class KnownWire:
    """A `WireSeen` where its view can say something."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_variance_px2: float


def seen(view: CalibratedView, wire: WireSeen) -> KnownWire:
    """Without the points outside the view's calibrated region."""
    kept = np.array([_in_region(view, uv) for uv in wire.uv_px], dtype=bool)
    if np.count_nonzero(kept) < CURVE:
        raise ReconstructionRefusedError(
            f"the wire lies outside the region that view {view.name!r} is calibrated in; move the frame so that its "
            "beads surround it"
        )
    return KnownWire(wire.uv_px[kept], wire.variance_px2[kept], wire.tip_uv_px, float(wire.tip_variance_px2))


def start_movement(
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]], landmarks: Landmarks
) -> tuple[np.ndarray, RigidTransform]:
    """Landmarks (N, 3) in the planning CFCS, and how they moved to where the check shows them."""
    if not len(landmarks):
        return np.zeros((0, 3)), RigidTransform.identity()
    spread = np.broadcast_to(landmarks.sd_px**2 * np.eye(2), (2, len(landmarks), 2, 2))
    before = reconstruct(views[0], landmarks.planned_uv_px, spread).xyz_mm
    after = reconstruct(views[1], landmarks.checked_uv_px, spread).xyz_mm
    rotation = Rotation.identity()
    if len(landmarks) >= FEWEST_LANDMARKS:
        rotation = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))[0]
    return before, RigidTransform.from_components(after.mean(axis=0) - rotation.apply(before.mean(axis=0)), rotation)


def start_wire(
    trajectory: Trajectory,
    axes: np.ndarray,
    movement: RigidTransform,
    views: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
) -> tuple[np.ndarray, float]:
    """Curve (CURVE, 2) and tip, mm along the plan: where the planes of both views' lines of sight meet.

    `axes` (3, 3): rows across the plan, twice, and along it. Raises ReconstructionRefusedError.
    """
    normals, through = [], []
    for view, wire in zip(views, wires, strict=True):
        lines = view.lines_of_sight(np.concatenate([wire.uv_px, wire.tip_uv_px[None]]))
        normals.append(np.linalg.svd(lines.directions)[2][2])
        through.append(lines)
    way = np.cross(*normals)
    if np.linalg.norm(way) < np.sin(SMALLEST_ANGLE_RAD):
        raise ReconstructionRefusedError(
            "both views see the wire in one plane, so its place in space does not follow; take one of them from "
            "another direction"
        )
    way /= np.linalg.norm(way)
    middle = movement.apply((trajectory.entry_mm + trajectory.end_mm) / 2)
    focal = [lines.focal_point_mm for lines in through]
    on = np.linalg.solve(np.stack([*normals, way]), [normals[0] @ focal[0], normals[1] @ focal[1], way @ middle])
    back = movement.inv()
    origin, way = back.apply(on), back.rotation.apply(way)
    way = way if way @ axes[2] > 0 else -way
    if way @ axes[2] < _LEAST_COSINE:
        angle = np.rad2deg(np.arccos(way @ axes[2]))
        raise ReconstructionRefusedError(
            f"the line seen lies at {angle:.0f}° to the plan: the images show another wire, or are of another plan"
        )
    off = (origin - trajectory.entry_mm) @ axes.T
    slope = axes[:2] @ way / (axes[2] @ way)
    curve = np.zeros((CURVE, 2))
    curve[0], curve[1] = off[:2] - slope * off[2], slope * trajectory.length_mm
    ends = [
        nearest_approach(lines.focal_point_mm, lines.directions[-1], on, movement.rotation.apply(way)).second_mm
        for lines in through
    ]
    along = (back.apply(np.array(ends)) - trajectory.entry_mm) @ axes[2]
    if (apart := float(np.ptp(along))) > _TIPS_APART_MM:
        raise ReconstructionRefusedError(
            f"the tips seen in the two images lie {apart:.0f} mm apart along the wire: the images are exchanged, "
            "or one does not show this wire's tip"
        )
    return curve, float(along.mean())


def terms(share: np.ndarray) -> np.ndarray:
    """(..., CURVE) of the wire's curve at shares of the planned length; those of bending vanish at entry and end."""
    bend = share * (share - 1)
    return np.stack([np.ones_like(share), share, bend, bend * (2 * share - 1)], axis=-1)


def _in_region(view: CalibratedView, uv_px: np.ndarray) -> bool:
    try:
        view.lines_of_sight(uv_px[None])
    except OutsideRegionError:
        return False
    return True
