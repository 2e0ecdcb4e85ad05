"""From a rough start, or none, to the pose: many cheap starts on small images, few of them refined on larger ones."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from sightline.calibration import CalibratedView
from sightline.common.geometry.lines import meeting_point
from sightline.errors import UnusableInputError
from sightline.from_images.registration.align import (
    CLOSE,
    COARSE,
    FINE,
    FLAT,
    IMAGE_FLOOR,
    MIDDLE,
    SHADOW_FLOOR,
    BoneFit,
    align,
    moved,
)
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.cast import shadow
from sightline.from_images.registration.observed import BoneShot, Observed
from sightline.from_images.registration.similarity import Normalised
from sightline.imaging.volumes.volume import Volume

# [ours] rotations tried: within 20° of a start 100 leave one that is at most 8° off, of all rotations 4,000 one 10°
# off; how many places of them are refined; and fits that are kept after each level. Without a start a few steps sort
# what the correlation alone does not: the right place of a pelvis may come 110th of 4,000, and then 27th.
_NEAR, _ALL = 100, 4000
_REFINED_NEAR, _REFINED_ALL = 40, 300
_LEVELS = (replace(COARSE, rounds=3), 40), (COARSE, 16), (MIDDLE, 4), (CLOSE, 2), (FINE, 2)
_APART_MM = 25.0  # between places tried of one rotation: a neighbour such as the next vertebra may match better [ours]
_FIELD_MM = 150.0  # without a start the bone lies at most so far from where the images' middles meet [ours]


@dataclass(frozen=True, eq=False)
class BoneStart:
    """A pose, and how far it may be off: each coordinate of the shift, mm, and of the rotation vector, rad."""

    pose: RigidTransform
    shift_mm: float = 10.0
    turn_rad: float = np.deg2rad(10.0)

    @property
    def reach_mm(self) -> float:
        """How far the centre may be off, with a margin: a vertebra's neighbour, which may fit too, is further."""
        return 2 * self.shift_mm

    def known_mm(self, bone: ScannedBone) -> np.ndarray:
        """Return the point (3,), CFCS, that lies within reach of its place whatever the rotation is."""
        return self.pose.apply(bone.centre_mm)

    def reaches(self, pose: RigidTransform, bone: ScannedBone) -> bool:
        """Return whether a pose may be that of the bone."""
        at = self.known_mm(bone)
        return bool(np.linalg.norm((pose * self.pose.inv()).apply(at) - at) <= self.reach_mm)

    def turned(self, bone: ScannedBone) -> list[RigidTransform]:
        """Return poses within reach of the rotation, the given one first."""
        ways = 2 * qmc.Halton(3, scramble=False).random(_NEAR) - 1
        ways[0] = 0.0
        centre = self.pose.apply(bone.centre_mm)
        return [moved(self.pose, np.append(self.turn_rad * way, np.zeros(3)), centre) for way in ways]


def _started(shots: Sequence[BoneShot], bone: ScannedBone, start: BoneStart | None) -> list[RigidTransform]:
    """Return poses to refine. Raises UnusableInputError where no view shows the place of the start."""
    if start is None:
        at = meeting((shot.view, shot.middle_px) for shot in shots)
        turns = Rotation.from_quat(_all_turns(_ALL))
        poses = [RigidTransform.from_components(at - turn.apply(bone.centre_mm), turn) for turn in turns]
        found = _shifted(shots, bone, poses, _FIELD_MM)[:_REFINED_ALL]
    else:
        found = _shifted(shots, bone, start.turned(bone), start.reach_mm)[:_REFINED_NEAR]
    if not found:
        raise UnusableInputError(
            "the views do not show the place of the start; check that they are these images' views"
        )
    return found


def _all_turns(count: int) -> np.ndarray:
    """Return quaternions (N, 4) spread evenly over all rotations (super-Fibonacci; Alexa, CVPR 2022)."""
    k = np.arange(count) + 0.5
    radius, rest = np.sqrt(k / count), np.sqrt(1 - k / count)
    alpha, beta = 2 * np.pi * k / 2**0.5, 2 * np.pi * k / 1.533751168755204288118041
    return np.stack([radius * np.sin(alpha), radius * np.cos(alpha), rest * np.sin(beta), rest * np.cos(beta)], axis=1)


def meeting(seen: Iterable[tuple[CalibratedView, np.ndarray]]) -> np.ndarray:
    """Return the point (3,), CFCS, that is nearest to the lines of sight of a pixel (2,) in each view.

    Raises OutsideRegionError, ReconstructionRefusedError.
    """
    lines = [view.lines_of_sight(uv[None]) for view, uv in seen]
    return meeting_point(
        np.array([each.focal_point_mm for each in lines]), np.concatenate([each.directions for each in lines])
    )


def search(shots: Sequence[BoneShot], bone: ScannedBone, start: BoneStart | None) -> list[BoneFit]:
    """Return the different fits on the finest images, best first: near a start, or of all rotations.

    Raises UnusableInputError where no view shows the place of the start, or nothing near it fits.
    """
    poses, fits = _started(shots, bone, start), list[BoneFit]()
    for level, kept in _LEVELS:
        aligned = [align(shots, bone, level, pose) for pose in poses]
        near = [fit for fit in aligned if start is None or start.reaches(fit.pose, bone)]
        fits = _distinct(sorted(near, key=lambda fit: -fit.evidence), bone, 2 * level.spacing_mm)[:kept]
        poses = [fit.pose for fit in fits]
    if not fits and start is not None:
        raise UnusableInputError(
            f"nothing fits within {start.reach_mm:g} mm of the start: check that CT or mesh are of this bone and this "
            "side, that each image has its own view, and give a nearer start, or none"
        )
    return fits


def _distinct(fits: Sequence[BoneFit], bone: ScannedBone, same_mm: float) -> list[BoneFit]:
    """Return the fits of which each is the first within `same_mm`, at all corners of the scan."""
    kept: list[BoneFit] = []
    for fit in fits:
        corners = fit.pose.apply(bone.corners_mm)
        if all(np.linalg.norm(corners - other.pose.apply(bone.corners_mm), axis=1).max() > same_mm for other in kept):
            kept.append(fit)
    return kept


def _shifted(
    shots: Sequence[BoneShot], bone: ScannedBone, poses: Sequence[RigidTransform], reach_mm: float
) -> list[RigidTransform]:
    """Return poses about one centre, each shifted by at most `reach_mm` to where its shadows match the images best;
    best first."""
    centre = poses[0].apply(bone.centre_mm)
    shown = [_Shown.of(shot.pooled(COARSE.size)) for shot in shots]
    shifts = _ball(reach_mm, 2 * min(each.seen.mm_per_px(centre) for each in shown))
    entries = np.array([each.entries(centre, shifts) for each in shown])
    inside = (entries >= 0).all(axis=0)
    shifts, entries = shifts[inside], entries[:, inside]
    if not len(shifts):
        return []
    found = []
    for pose in poses:
        maps = [each.correlations(bone.at(COARSE.spacing_mm), pose).ravel() for each in shown]
        score = np.sum([values[at] for values, at in zip(maps, entries, strict=True)], axis=0)
        best = shifts[np.argmax(score)]
        elsewhere = np.where(np.linalg.norm(shifts - best, axis=1) > _APART_MM, score, -np.inf)
        for shift, value in ((best, score.max()), (shifts[np.argmax(elsewhere)], elsewhere.max())):
            found.append((value, RigidTransform.from_translation(shift) * pose))
    return [pose for _, pose in sorted(found, key=lambda entry: -entry[0])]


def _ball(radius_mm: float, spacing_mm: float) -> np.ndarray:
    """Return the points (N, 3) of a lattice within a radius of the origin."""
    along = spacing_mm * np.arange(-(radius_mm // spacing_mm), radius_mm // spacing_mm + 1)
    lattice = np.stack(np.meshgrid(along, along, along), axis=-1).reshape(-1, 3)
    return lattice[np.linalg.norm(lattice, axis=1) <= radius_mm]


@dataclass(frozen=True, eq=False)
class _Shown:
    """A whole image, normalised, with the transforms that correlations need."""

    seen: Observed
    spectra: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(seen: Observed) -> "_Shown":
        usable = seen.known.astype(np.float64)
        values = Normalised.of(seen.attenuation, usable, IMAGE_FLOOR).values * usable
        size = [2 * n for n in usable.shape]
        return _Shown(seen, (np.fft.rfft2(values, size), np.fft.rfft2(values**2, size)))

    def entries(self, centre_mm: np.ndarray, shifts_mm: np.ndarray) -> np.ndarray:
        """Return which entries (N,) of the correlations belong to shifts (N, 3) of the bone's centre; -1 where the
        shifted centre, or one of its neighbours, is not a calibrated pixel."""
        inner = cv2.erode(
            self.seen.calibrated.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0
        ).astype(bool)
        uv, known = self.seen.view.project_seen(centre_mm + np.concatenate([np.zeros((1, 3)), shifts_mm]))
        found = np.full(len(known), -1)
        if known[0]:
            at = self.seen.pooled_px(uv)
            inside = ((at >= 0) & (at < inner.shape[::-1])).all(axis=1)
            inside[inside] = inner[at[inside, 1], at[inside, 0]]
            columns, rows = (at - at[0]).T
            height, width = (2 * n for n in inner.shape)
            found[known] = np.where(inside, rows % height * width + columns % width, -1)
        return found[1:]

    def correlations(self, volume: Volume, pose: RigidTransform) -> np.ndarray:
        """Return the correlation (2H, 2W) of the bone's shadow with the image, by the shift in pixels; negative ones
        from the end. Each entry is the largest of its neighbours, since shifts are two pixels apart."""
        shape = self.seen.attenuation.shape
        drawn = Normalised.of(shadow(self.seen.rays, volume, pose).reshape(shape), np.ones(shape), SHADOW_FLOOR)
        weight = drawn.variance / (drawn.variance + FLAT**2)
        size = [2 * n for n in shape]
        both, power = (
            np.fft.irfft2(spectrum * np.fft.rfft2(template, size).conj(), size)
            for spectrum, template in zip(self.spectra, (weight * drawn.values, weight), strict=True)
        )
        score = both / np.sqrt(np.maximum((weight * drawn.values**2).sum() * power, 1e-6))
        return cv2.dilate(score, np.ones((3, 3)))
