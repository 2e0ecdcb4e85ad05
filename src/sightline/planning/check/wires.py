"""Wires in images: planned ones as a check image should show them, those found, and those in the bone, in space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.calibration.bead_view import bead_shadows_px
from sightline.calibration.view import CalibratedView
from sightline.common.checks import Check, failed
from sightline.common.geometry.lines import unit
from sightline.errors import OutsideRegionError, ReconstructionRefusedError, UnusableInputError
from sightline.planning.bone.drawings import Axis
from sightline.planning.bone.registered import RegisteredBone
from sightline.planning.nail.result import Hole
from sightline.planning.points.picks import DEFAULT_PICK_SD_PX, PickArrays
from sightline.planning.points.reconstruct import reconstruct
from sightline.planning.points.results import error_unknown

# Lengths that are searched outside the entry and beyond the planned depth, so that the tip is inside; the last outside
# the entry for a wire that waits in its guide [ours].
BEFORE_MM, BEYOND_MM, GUIDED_MM = 25.0, 15.0, 80.0
_STEP_MM = 1.0
_STILL = RigidTransform.identity()
# What a nail may cover in a check image [ours]: so much to either side of its hole, wider by a bone's movement.
_NAIL_MM, _BESIDE_NAIL_MM = 30.0, 2.0
_CURVE = 3  # degree of a wire's line in an image, as in the check shot
_CHOSEN_PX = 0.01  # s.d. along the line of the entry, which is chosen in the first image and not measured


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
    may be another one. `registered`: the bone was registered in both pairs of images, which tells `movement` without
    landmarks; the checks of both registrations.
    """

    movement: RigidTransform = field(default_factory=RigidTransform.identity)
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    straight: bool = False
    before_mm: float = 0.0
    by_landmarks: bool = False
    registered: tuple[Check, ...] = ()


STILL = Beforehand()


def by_bone(
    planned: RegisteredBone | None, now: RegisteredBone, ends_mm: np.ndarray, checked: Sequence[CalibratedView]
) -> Beforehand:
    """Return what a bone tells that is registered in the plan's images and `now`, in the images of the views `checked`.

    `ends_mm` (2, 3): of the plan. Raises UnusableInputError, also for other views, and ErrorUnknownError.
    """
    if planned is None:
        raise UnusableInputError(
            "the plan was made without a registered bone; plan again with it, or leave it out here"
        )
    now.refuse_other_views(checked)
    movement, covariance = planned.movement_to(now, ends_mm.mean(axis=0))
    before = [replace(check, sentence=f"In the plan's images: {check.sentence}") for check in failed(planned.checks)]
    own = now.checks_beside([check.of_view(view.name) for view in checked for check in view.checks])
    return Beforehand(movement, covariance, registered=(*own, *before))


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


@dataclass(frozen=True, eq=False)
class _Point:
    """A point of a wire in an image: `uv_px` (2,), its covariance (2, 2), and the unit tangent `along` (2,)."""

    uv_px: np.ndarray
    covariance_px2: np.ndarray
    along: np.ndarray


@dataclass(frozen=True, eq=False)
class PlacedWire(Axis):
    """A wire found in the planning images. `picks`: its two ends in the first two views, of which it is made: with them
    its errors are joint with those of wires that are planned on the same views."""

    picks: PickArrays


def placed_wires(
    views: Sequence[CalibratedView], wires: Mapping[str, Sequence[WireSeen]], entries_mm: Mapping[str, np.ndarray]
) -> dict[str, PlacedWire]:
    """Return the wires by key, each from near its entry (3,) to its tip, with its covariance, CFCS.

    `wires`: each as the first and the second of two `views` show it. The distance between the lines of sight of the
    tips decides whether both images show the same wire. Raises ReconstructionRefusedError where it contradicts that,
    or where it does not rule out another assignment of the lines to wires; ErrorUnknownError, OutsideRegionError.
    """
    keys, both = list(wires), views[:2]
    lines = [[_Line.of(wire) for wire in wires[key]] for key in keys]
    points = [
        [line.point(view.project(entries_mm[key][None])[0], 0.0) for view, line in zip(both, each, strict=True)]
        for key, each in zip(keys, lines, strict=True)
    ]
    tips = [
        [line.point(wire.tip_uv_px, wire.tip_variance_px2) for wire, line in zip(wires[key], each, strict=True)]
        for key, each in zip(keys, lines, strict=True)
    ]
    for key, shown in zip(keys, tips, strict=True):
        if (gap := _gap_mm(both, shown)) is not None:
            raise ReconstructionRefusedError(
                f"the lines of sight of the tips of the wire {key!r} pass {gap:.1f} mm apart: the two images show two "
                "different wires, or a tip is wrong; click the same wire in both"
            )
    for (first, a), (second, b) in permutations(zip(keys, tips, strict=True), 2):
        if _gap_mm(both, [a[0], b[1]]) is None:
            raise ReconstructionRefusedError(
                f"the tip of the wire {first!r} in one image also fits that of the wire {second!r} in the other, so it "
                "cannot be told which line is which wire; take one of the images from another direction"
            )
    ends = [point for pair in zip(points, tips, strict=True) for point in pair]
    uv, spread = (
        np.array([[getattr(point, n) for point in end] for end in ends]).swapaxes(0, 1)
        for n in ("uv_px", "covariance_px2")
    )
    across = np.zeros_like(uv)
    for k, (chosen, other) in enumerate(points):
        spread[0, 2 * k] += _CHOSEN_PX**2 * np.outer(chosen.along, chosen.along)
        across[1, 2 * k] = other.along
    picks = PickArrays(uv, spread, across)
    seen = reconstruct(both, *picks[:2], across_px=across)
    joint = seen.joint_covariance_mm2
    if joint is None:
        raise error_unknown()
    rows = [slice(2 * k, 2 * k + 2) for k in range(len(keys))]
    return {
        key: PlacedWire(
            seen.xyz_mm[at], joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6], PickArrays(*(part[:, at] for part in picks))
        )
        for k, (key, at) in enumerate(zip(keys, rows, strict=True))
    }


def _gap_mm(views: Sequence[CalibratedView], tips: Sequence[_Point]) -> float | None:
    """Return the distance between the lines of sight of two tips where their errors do not explain it, else None."""
    uv, spread = (np.array([[getattr(tip, name)] for tip in tips]) for name in ("uv_px", "covariance_px2"))
    seen = reconstruct(views, uv, spread)
    if seen.joint_covariance_mm2 is None:
        raise error_unknown()
    return float(seen.gap_mm[0]) if seen.gap_failed[0] else None


@dataclass(frozen=True, eq=False)
class _Line:
    """A wire's line in an image as a polynomial: x across `along` (2,) by s along it, in units of `scale_px`, from the
    `middle_px` (2,). `gain` maps the line's weighted offsets to the coefficients."""

    middle_px: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    scale_px: float
    gain: np.ndarray
    curve: np.polynomial.Polynomial

    @staticmethod
    def of(wire: WireSeen) -> "_Line":
        middle = wire.uv_px.mean(axis=0)
        along = np.linalg.svd(wire.uv_px - middle)[2][0]
        normal = np.array([-along[1], along[0]])
        s, x = (wire.uv_px - middle) @ along, (wire.uv_px - middle) @ normal
        scale = float(np.abs(s).max())
        weight = 1 / np.sqrt(wire.variance_px2)
        gain = np.linalg.pinv(weight[:, None] * np.polynomial.polynomial.polyvander(s / scale, _CURVE))
        return _Line(middle, along, normal, scale, gain, np.polynomial.Polynomial(gain @ (weight * x)))

    def point(self, near_px: np.ndarray, along_px2: float) -> _Point:
        """Return the line's point beside a pixel (2,), with the variance `along_px2` along the line."""
        at = float((near_px - self.middle_px) @ self.along) / self.scale_px
        powers = np.polynomial.polynomial.polyvander(np.array([at]), _CURVE)[0]
        tangent = unit(self.along + self.curve.deriv()(at) / self.scale_px * self.normal)
        beside = np.array([-tangent[1], tangent[0]])
        variance = float(np.sum((powers @ self.gain) ** 2))
        spread = variance * np.outer(beside, beside) + along_px2 * np.outer(tangent, tangent)
        uv = self.middle_px + at * self.scale_px * self.along + self.curve(at) * self.normal
        return _Point(uv, spread, tangent)
