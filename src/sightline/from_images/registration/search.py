"""From a rough start, or none, to the pose: many cheap starts on small images, few of them refined on larger ones."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from sightline.calibration import CalibratedView
from sightline.common.geometry.lines import meeting_point
from sightline.errors import UnusableInputError
from sightline.from_images.registration.align import (
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

# [ours] rotations tried: within 20° of a start 100 leave one that is at most 8° off, of all rotations 2,000 one 12°
# off; how many of them are refined; and fits that are kept after each level.
_NEAR, _ALL = 100, 2000
_REFINED_NEAR, _REFINED_ALL = 8, 24
_LEVELS = (COARSE, 6), (MIDDLE, 2), (FINE, 2)
_SAME_MM = 1.0  # fits nearer to each other are one [ours]
_NOWHERE = -1.0  # less than any correlation of a shadow with an image
_FIELD_MM = 150.0  # without a start the bone lies at most so far from where the images' middles meet [ours]


@dataclass(frozen=True, eq=False)
class BoneStart:
    """A pose, and how far it may be off: each coordinate of the shift, mm, and of the rotation vector, rad."""

    pose: RigidTransform
    shift_mm: float = 10.0
    turn_rad: float = np.deg2rad(10.0)

    def turned(self, bone: ScannedBone) -> list[RigidTransform]:
        """Return poses within reach of the rotation, the given one first."""
        ways = 2 * qmc.Halton(3, scramble=False).random(_NEAR) - 1
        ways[0] = 0.0
        centre = self.pose.apply(bone.centre_mm)
        return [moved(self.pose, np.append(self.turn_rad * way, np.zeros(3)), centre) for way in ways]


def started(shots: Sequence[BoneShot], bone: ScannedBone, start: BoneStart | None) -> list[RigidTransform]:
    """Return poses to refine. Raises UnusableInputError where no view shows the place of the start."""
    if start is None:
        at = meeting((shot.view, shot.middle_px) for shot in shots)
        turns = Rotation.from_quat(_all_turns(_ALL))
        poses = [RigidTransform.from_components(at - turn.apply(bone.centre_mm), turn) for turn in turns]
        found = _shifted(shots, bone, poses, _FIELD_MM)[:_REFINED_ALL]
    else:
        found = _shifted(shots, bone, start.turned(bone), 2 * start.shift_mm)[:_REFINED_NEAR]
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


def search(shots: Sequence[BoneShot], bone: ScannedBone, poses: Iterable[RigidTransform]) -> list[BoneFit]:
    """Return the different fits that are reached from `poses` on the finest images, best first."""
    fits: list[BoneFit] = []
    for level, kept in _LEVELS:
        fits = [align(shots, bone, level, pose) for pose in poses]
        fits = _distinct(sorted(fits, key=lambda fit: fit.loss), bone)[:kept]
        poses = [fit.pose for fit in fits]
    return fits


def _distinct(fits: Sequence[BoneFit], bone: ScannedBone) -> list[BoneFit]:
    kept: list[BoneFit] = []
    for fit in fits:
        corners = fit.pose.apply(bone.corners_mm)
        if all(np.linalg.norm(corners - other.pose.apply(bone.corners_mm), axis=1).max() > _SAME_MM for other in kept):
            kept.append(fit)
    return kept


def _shifted(
    shots: Sequence[BoneShot], bone: ScannedBone, poses: Sequence[RigidTransform], reach_mm: float
) -> list[RigidTransform]:
    """Return the poses, each shifted by at most about `reach_mm` to where its shadows match the images best; best
    first."""
    shown = [_Shown.of(shot.pooled(COARSE.size)) for shot in shots]
    found = []
    for pose in poses:
        centre = pose.apply(bone.centre_mm)
        matches = [image.match(bone.at(COARSE.spacing_mm), pose, centre, reach_mm) for image in shown]
        if any(match is None for match in matches):
            continue
        at = meeting((shot.view, match[1]) for shot, match in zip(shots, matches, strict=True) if match)
        score = sum(match[0] for match in matches if match)
        found.append((score, RigidTransform.from_translation(at - centre) * pose))
    return [pose for _, pose in sorted(found, key=lambda entry: -entry[0])]


@dataclass(frozen=True, eq=False)
class _Shown:
    """A whole image, normalised, with the transforms that correlations need; `inner` (H, W) bool: calibrated pixels
    whose neighbours are calibrated too."""

    seen: Observed
    inner: np.ndarray
    spectra: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(seen: Observed) -> "_Shown":
        usable = seen.known.astype(np.float64)
        values = Normalised.of(seen.attenuation, usable, IMAGE_FLOOR).values * usable
        size = [2 * n for n in usable.shape]
        inner = cv2.erode(
            seen.calibrated.astype(np.uint8), np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT, borderValue=0
        ).astype(bool)
        return _Shown(seen, inner, (np.fft.rfft2(values, size), np.fft.rfft2(values**2, size)))

    def match(
        self, volume: Volume, pose: RigidTransform, centre_mm: np.ndarray, reach_mm: float
    ) -> tuple[float, np.ndarray] | None:
        """Return the best correlation of a shadow with the image, and the pixel (2,) at which it has the shadow's
        centre."""
        at, shown = self.seen.view.project_seen(centre_mm[None])
        if not shown[0]:
            return None
        shape = self.inner.shape
        drawn = Normalised.of(shadow(self.seen.rays, volume, pose).reshape(shape), np.ones(shape), SHADOW_FLOOR)
        size = self.spectra[0].shape[0], 2 * (self.spectra[0].shape[1] - 1)
        weight = drawn.variance / (drawn.variance + FLAT**2)
        both, power = (
            np.fft.irfft2(spectrum * np.fft.rfft2(template, size).conj(), size)
            for spectrum, template in zip(self.spectra, (weight * drawn.values, weight), strict=True)
        )
        score = both / np.sqrt(np.maximum((weight * drawn.values**2).sum() * power, 1e-6))
        reach = min(reach_mm / self.seen.mm_per_px(centre_mm), min(shape) - 1)
        rows, columns = (np.fft.fftfreq(n, 1 / n).astype(int) for n in size)
        score[np.hypot(rows[:, None], columns) > max(reach, 1.0)] = _NOWHERE
        column, row = self.seen.pooled_px(at)[0]
        score[~_taken(self.inner, row + rows, column + columns)] = _NOWHERE
        row, column = np.unravel_index(np.argmax(score), score.shape)
        if score[row, column] == _NOWHERE:
            return None
        return float(score[row, column]), at[0] + self.seen.factor * np.array([columns[column], rows[row]])


def _taken(mask: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return mask[rows][:, columns], False beyond the mask."""
    inside = [(at >= 0) & (at < n) for at, n in zip((rows, columns), mask.shape, strict=True)]
    taken = mask[np.ix_(*(np.clip(at, 0, n - 1) for at, n in zip((rows, columns), mask.shape, strict=True)))]
    return taken & inside[0][:, None] & inside[1]
