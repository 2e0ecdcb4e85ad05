"""Inputs of a check shot's adjustment (landmarks, wires found in the images) and starting values of its unknowns."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sightline.calibration.view import CalibratedView
from sightline.common.geometry.lines import nearest_approach
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.planning.check.result import MIN_LANDMARKS
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.solution import MIN_ANGLE_RAD
from sightline.planning.points.trajectory import Trajectory

CURVE = 4  # terms of the wire's curve along each perpendicular axis: offset, direction, two of bending
_MIN_COSINE = 0.8  # of the angle between wire and plan: beyond 37° it is another wire [ours]
_MAX_TIP_GAP_MM = 5.0  # along the wire, between the tips of the two views; the error of a tip is 0.2 mm [ours]


class WireSeen(Protocol):
    """A wire found in one image, px; a point of the centre line measures nothing along the tangent."""

    @property
    def uv_px(self) -> np.ndarray:
        """(N, 2) points of the centre line."""
        ...

    @property
    def variance_px2(self) -> np.ndarray:
        """(N,) variance of each point across the line."""
        ...

    @property
    def tip_uv_px(self) -> np.ndarray:
        """(2,) the tip."""
        ...

    @property
    def tip_variance_px2(self) -> float:
        """Variance of the tip along the line."""
        ...


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points of the bone picked in the planning images and found again in the check images, (2, N, 2) px each, N >= 0.

    `sd_px`: standard deviation of a pick, per axis. Raises UnusableInputError.

    >>> planned, found = np.zeros((2, 3, 2)), np.ones((2, 3, 2))  # three points, clicked in both pairs of images
    >>> landmarks = sl.Landmarks(planned, found)
    """

    planned_uv_px: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 2)))
    checked_uv_px: np.ndarray = field(default_factory=lambda: np.zeros((2, 0, 2)))
    sd_px: float = DEFAULT_PICK_SD_PX

    def __post_init__(self) -> None:
        planned, checked = (np.asarray(uv, dtype=np.float64) for uv in (self.planned_uv_px, self.checked_uv_px))
        if planned.shape != checked.shape or planned.ndim != 3 or planned.shape[::2] != (2, 2):
            raise UnusableInputError(
                f"landmarks have the shapes {planned.shape} and {checked.shape}; give (2, N, 2) for both: the same "
                "points in both pairs of images"
            )
        if not (
            np.isfinite(planned).all() and np.isfinite(checked).all() and np.isfinite(self.sd_px) and self.sd_px > 0
        ):
            raise UnusableInputError(
                f"give landmarks as finite pixels, and a positive standard deviation; got {self.sd_px} px"
            )

    def __len__(self) -> int:
        return np.shape(self.planned_uv_px)[1]


@dataclass(frozen=True, eq=False)
class Beforehand:
    """What is known of the wire's images before they are measured.

    `movement`: of a bone at rest, from planning CFCS to that of the images; `covariance` (6, 6) of its rotation (rad,
    about the middle of the plan) and shift (mm, there), axes of the latter CFCS. `straight`: the wire is in its guide,
    outside the bone. `before_mm`: how far before the entry bone may begin, so that more of the wire outside it counts.
    `by_landmarks`: the images' frame is fixed to the patient, so that landmarks alone tell `movement`; the plan's frame
    may be another one.
    """

    movement: RigidTransform = field(default_factory=RigidTransform.identity)
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    straight: bool = False
    before_mm: float = 0.0
    by_landmarks: bool = False


STILL = Beforehand()


@dataclass(frozen=True, eq=False)
class KnownWire:
    """A `WireSeen` restricted to the region in which its view is calibrated."""

    uv_px: np.ndarray
    variance_px2: np.ndarray
    tip_uv_px: np.ndarray
    tip_variance_px2: float


def picked_wire(uv_px: np.ndarray, sd_px: float) -> KnownWire:
    """Return the wire through points (M, 2) picked on its centre line, the tip last, each with the error `sd_px`."""
    return KnownWire(uv_px[:-1], np.full(len(uv_px) - 1, sd_px**2), uv_px[-1], sd_px**2)


def within_region(view: CalibratedView, wire: WireSeen) -> KnownWire:
    """Return the wire without its points outside the view's calibrated region. Raises ReconstructionRefusedError."""
    kept = np.array([_in_region(view, uv) for uv in wire.uv_px], dtype=bool)
    if np.count_nonzero(kept) < CURVE:
        raise ReconstructionRefusedError(
            f"the wire lies outside the region that view {view.name!r} is calibrated in; move the frame so that its "
            "beads surround it"
        )
    return KnownWire(wire.uv_px[kept], wire.variance_px2[kept], wire.tip_uv_px, float(wire.tip_variance_px2))


def start_movement(
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]], landmarks: Landmarks, known: RigidTransform
) -> tuple[np.ndarray, RigidTransform]:
    """Return the landmarks (N, 3) in the planning CFCS, and the rigid motion to their places in the check's CFCS.

    `known`: the motion as far as landmarks do not show it.
    """
    if not len(landmarks):
        return np.zeros((0, 3)), known
    spread = np.broadcast_to(landmarks.sd_px**2 * np.eye(2), (2, len(landmarks), 2, 2))
    before = reconstruct(views[0][:2], landmarks.planned_uv_px, spread).xyz_mm
    after = reconstruct(views[1], landmarks.checked_uv_px, spread).xyz_mm
    rotation = known.rotation
    if len(landmarks) >= MIN_LANDMARKS:
        rotation = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))[0]
    return before, RigidTransform.from_components(after.mean(axis=0) - rotation.apply(before.mean(axis=0)), rotation)


def on_patient(
    views: tuple[Sequence[CalibratedView], Sequence[CalibratedView]], landmarks: Landmarks, *, straight: bool
) -> Beforehand:
    """Return what is known of images whose frame is fixed to the patient. Raises UnusableInputError for fewer landmarks
    than determine where it is."""
    if len(landmarks) < MIN_LANDMARKS:
        raise UnusableInputError(
            f"find {MIN_LANDMARKS} landmarks of the bone or more in all four images, not {len(landmarks)}: the robot "
            "does not know where a frame is that is fixed to the patient"
        )
    movement = start_movement(views, landmarks, RigidTransform.identity())[1]
    return Beforehand(movement, straight=straight, by_landmarks=True)


def start_wire(
    trajectory: Trajectory,
    axes: np.ndarray,
    movement: RigidTransform,
    views: Sequence[CalibratedView],
    wires: Sequence[WireSeen],
) -> tuple[np.ndarray, float]:
    """Return curve (CURVE, 2) and tip (mm along the plan) of the line in which the planes of both views' lines of sight
    intersect.

    `axes` (3, 3): two rows perpendicular to the plan, one along it. Raises ReconstructionRefusedError.
    """
    normals, through = [], []
    for view, wire in zip(views, wires, strict=True):
        lines = view.lines_of_sight(np.concatenate([wire.uv_px, wire.tip_uv_px[None]]))
        normals.append(np.linalg.svd(lines.directions)[2][2])
        through.append(lines)
    direction = np.cross(*normals)
    if np.linalg.norm(direction) < np.sin(MIN_ANGLE_RAD):
        raise ReconstructionRefusedError(
            "both views see the wire in one plane, which does not determine its place in space; take one of the images "
            "from another direction"
        )
    direction /= np.linalg.norm(direction)
    middle = movement.apply((trajectory.entry_mm + trajectory.end_mm) / 2)
    focal = [lines.focal_point_mm for lines in through]
    on = np.linalg.solve(
        np.stack([*normals, direction]), [normals[0] @ focal[0], normals[1] @ focal[1], direction @ middle]
    )
    back = movement.inv()
    origin, direction = back.apply(on), back.rotation.apply(direction)
    direction = direction if direction @ axes[2] > 0 else -direction
    if direction @ axes[2] < _MIN_COSINE:
        angle, limit = np.rad2deg(np.arccos([direction @ axes[2], _MIN_COSINE]))
        raise ReconstructionRefusedError(
            f"the wire lies at {angle:.0f}° to the plan (at most {limit:.0f}°): check that the images show this wire "
            "and belong to this plan"
        )
    off = (origin - trajectory.entry_mm) @ axes.T
    slope = axes[:2] @ direction / (axes[2] @ direction)
    curve = np.zeros((CURVE, 2))
    curve[0], curve[1] = off[:2] - slope * off[2], slope * trajectory.length_mm
    ends = [
        nearest_approach(lines.focal_point_mm, lines.directions[-1], on, movement.rotation.apply(direction)).second_mm
        for lines in through
    ]
    along = (back.apply(np.array(ends)) - trajectory.entry_mm) @ axes[2]
    if (apart := float(np.ptp(along))) > _MAX_TIP_GAP_MM:
        raise ReconstructionRefusedError(
            f"the tips seen in the two images lie {apart:.0f} mm apart along the wire (at most {_MAX_TIP_GAP_MM:.0f} "
            "mm): the images are exchanged, or one does not show this wire's tip"
        )
    return curve, float(along.mean())


def terms(share: np.ndarray) -> np.ndarray:
    """Return the terms (..., CURVE) of the wire's curve at fractions `share` of the planned length.

    The bending terms vanish at entry and end.
    """
    bend = share * (share - 1)
    return np.stack([np.ones_like(share), share, bend, bend * (2 * share - 1)], axis=-1)


def _in_region(view: CalibratedView, uv_px: np.ndarray) -> bool:
    try:
        view.lines_of_sight(uv_px[None])
    except OutsideRegionError:
        return False
    return True
