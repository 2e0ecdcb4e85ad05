"""Each view's own pose of the bone, and how far the views disagree: movement between the images shows here."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from sightline.common.geometry.covariance import length_quantile
from sightline.common.geometry.lines import unit
from sightline.from_images.registration import errors
from sightline.from_images.registration.align import FINE, BoneFit, align
from sightline.from_images.registration.bone import ScannedBone
from sightline.from_images.registration.observed import BoneShot

# A shadow that is larger by this share looks nearer to the source: 0.08 mm on either side of a femur's shaft. Twice:
# alike in all views, as the CT's blur and threshold leave it, and in each view, as the image's do [gVirtualXray: then
# chi-squares of single views' poses are what they should be].
_SIZE_SD = 0.0016


@dataclass(frozen=True, eq=False)
class Apart:
    """Poses of the bone in V single views, less their common pose: `steps` (V, 6), rotation vector about its centre and
    shift, mm, with the joint `covariance` (6V, 6V); `beams` (V, 3): unit vectors, CFCS; `along_beam_95_mm` of each
    view, as in `BoneView`."""

    poses: Sequence[RigidTransform]
    steps: np.ndarray
    covariance: np.ndarray
    beams: np.ndarray
    along_beam_95_mm: Sequence[float | None]

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `sigma` squared."""
        return 6 * (len(self.steps) - 1)

    @cached_property
    def sigma(self) -> float:
        """How many standard deviations the views are apart: the root of chi-square."""
        return float(self._lengths(self.steps.ravel()))

    @property
    def sigma_per_mm(self) -> float:
        """How much further they are apart for each mm that the bone moves along a beam before the last image; of the
        beam for which it is least."""
        moved = np.zeros((len(self.steps) * 6, len(self.beams)))
        moved[-3:] = self.beams.T
        return float(self._lengths(moved).min())

    def _lengths(self, steps: np.ndarray) -> np.ndarray:
        """Return the lengths (...), s.d., of steps (6V, ...) of all views less that of the first."""
        to_first = np.concatenate([-np.tile(np.eye(6), (len(self.steps) - 1, 1)), np.eye(self.freedom)], axis=1)
        difference = to_first @ steps
        weighted = np.linalg.solve(to_first @ self.covariance @ to_first.T, difference)
        return np.sqrt((difference * weighted).sum(axis=0))


def apart(shots: Sequence[BoneShot], bone: ScannedBone, fit: BoneFit) -> Apart:
    """Return how far the bone's poses in single views are from the common one."""
    centre, spread = fit.pose.apply(bone.centre_mm), fit.pose.rotation.apply(bone.spread_mm)
    count = len(shots)
    steps, covariance = np.zeros((count, 6)), np.zeros((6 * count, 6 * count))
    size, poses, along = np.zeros((count, 6)), list[RigidTransform](), list[float | None]()
    from_source = np.array([centre - shot.view.focal_point_mm for shot in shots])
    beams, size[:, 3:] = unit(from_source), _SIZE_SD * from_source
    for k, shot in enumerate(shots):
        own = align([shot], bone, FINE, fit.pose)
        poses.append(own.pose)
        change = own.pose * fit.pose.inv()
        steps[k] = np.concatenate([change.rotation.as_rotvec(), change.apply(centre) - centre])
        part = slice(6 * k, 6 * k + 6)
        covariance[part, part] = errors.of_images(own.views) + np.outer(size[k], size[k])
        calibration = errors.of_calibration([shot.view], centre, spread)
        if calibration is not None:
            covariance[part, part] += calibration
        way = np.append(np.zeros(3), beams[k])
        variance = way @ (covariance[part, part] + np.outer(size[k], size[k])) @ way
        along.append(None if calibration is None else float(length_quantile(np.array([[variance]]))))
    return Apart(poses, steps, covariance + np.outer(size, size), beams, along)
