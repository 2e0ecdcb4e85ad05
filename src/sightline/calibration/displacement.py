"""Displacement of a target's lines of sight against the frame between two images.

The errors of frame and map are the same in both images and cancel; only the noise of the beads' centres remains.
Distortion is assumed constant. Any movement (of the frame, the C-arm, or the source against the detector) is then a
homography of the reference plane (8 parameters) and a new focal point (3). These 11 parameters, and from them the
displacement of the lines of sight at a target, follow from the beads by weighted least squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.bead_view import BeadView
from sightline.calibration.plates.beads import match
from sightline.calibration.plates.joint import JointFit
from sightline.common.fitting import variance_ratio
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, UnusableInputError
from sightline.frame import Frame

MIN_BEADS = 12  # 24 equations for 11 parameters: twice as many, to find wrong beads [calc]
_PARAMETERS = 11
_UNIT_MM = 100.0  # unit of the plane's coordinates in the homography, so that its parameters are of similar size [calc]
_WRONG_M2 = 13.8  # chi-square, two degrees of freedom, once in 1,000: an instrument in front of a bead
_ROUNDS = 3  # of leaving out wrong beads


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacement of the lines of sight of T targets, at the targets, perpendicular to the lines, mm.

    `shift_mm` (T, 2): along two axes perpendicular to the line; `covariance_mm2` (T, 2, 2): from this image's beads;
    `rest_mm2` (T, 2, 2): from the beads at rest, the same for every image compared with them. `beads`: number used.
    """

    shift_mm: np.ndarray
    covariance_mm2: np.ndarray
    rest_mm2: np.ndarray
    beads: int

    @property
    def length_mm(self) -> float:
        """Largest displacement of all targets."""
        return float(np.hypot(*self.shift_mm.T).max())

    @property
    def sd_mm(self) -> float:
        """Largest standard deviation from this image's beads, over targets and directions."""
        return _largest_sd(self.covariance_mm2)

    @property
    def rest_sd_mm(self) -> float:
        """Largest standard deviation from the beads at rest, over targets and directions."""
        return _largest_sd(self.rest_mm2)


@dataclass(frozen=True, eq=False)
class Rest:
    """The beads at rest, mapped to the reference plane by one view calibrated with the smooth method.

    `place_mm` (M, 2) and `covariance_mm2` (M, 2, 2) on the reference plane, for every fiducial of the view in the
    frame's order; NaN where the fiducial was not seen. `targets_mm` (T, 3), CFCS.
    """

    frame: Frame
    view: BeadView
    fit: JointFit
    place_mm: np.ndarray
    covariance_mm2: np.ndarray
    targets_mm: np.ndarray

    @staticmethod
    def of(view: BeadView, frame: Frame, seen: Sequence[Observations], targets_mm: np.ndarray) -> "Rest":
        """Return the mean of one or more images' beads. Raises UnusableInputError, and the errors of `match`."""
        if not isinstance(view.posterior, JointFit):
            raise UnusableInputError("calibrate with 'smooth' to measure movements; other methods do not support it")
        each = np.full((2, len(seen), len(frame.view(view.name).fiducials), 2, 2), np.nan)
        for k, observations in enumerate(seen):
            rows, place, covariance = _on_plane(view, frame, observations)
            each[0, k, rows, 0], each[1, k, rows] = place, covariance
        known = np.isfinite(each[0, :, :, 0, 0])
        count = np.maximum(known.sum(axis=0), 1)[:, None]
        place = np.where(known[..., None], each[0, :, :, 0], 0.0).sum(axis=0) / count
        covariance = np.where(known[..., None, None], each[1], 0.0).sum(axis=0) / count[..., None] ** 2
        never = ~known.any(axis=0)
        place[never], covariance[never] = np.nan, np.nan
        targets = np.asarray(targets_mm, dtype=np.float64).reshape(-1, 3)
        return Rest(frame, view, view.posterior, place, covariance, targets)

    def displacement(self, seen: Observations) -> Displacement:
        """Return the displacement of an image's beads against these.

        Raises CalibrationRefusedError where both have too few beads in common.
        """
        rows, place, covariance = _on_plane(self.view, self.frame, seen)
        both = np.isfinite(self.place_mm[rows, 0])
        rows, place, covariance = rows[both], place[both], covariance[both]
        fiducials = self.frame.view(self.view.name)
        xyz = np.concatenate([fiducials.xrii.xyz_mm, fiducials.source.xyz_mm])[rows]
        moved, at_rest = place - self.place_mm[rows], self.covariance_mm2[rows]
        design, to_target = self._design(xyz, self.place_mm[rows]), self._at_targets()
        gain, used, scale = _fitted(design, moved, np.linalg.inv(covariance + at_rest))
        response = np.einsum("tak,knb->tanb", to_target, gain)
        shift = np.einsum("tanb,nb->ta", response, moved[used])
        own, rest = (
            scale * np.einsum("tanb,nbc,tdnc->tad", response, c[used], response) for c in (covariance, at_rest)
        )
        return Displacement(shift, own, rest, int(used.sum()))

    def _design(self, xyz_mm: np.ndarray, place_mm: np.ndarray) -> np.ndarray:
        """Return (N, 2, 11): derivatives of the beads' places by homography and focal point."""
        return np.concatenate([-_homography(place_mm), self.fit.pencil.by_pq(xyz_mm)], axis=2)

    def _at_targets(self) -> np.ndarray:
        """Return (T, 2, 11): derivatives of the lines of sight at the targets, perpendicular to the lines."""
        pencil, plane = self.fit.pencil, self.fit.pencil.plane
        place, by_pq = pencil.project(self.targets_mm), pencil.by_pq(self.targets_mm)
        reach = 1.0 - plane.height_mm(self.targets_mm) * pencil.pq[2]
        on_plane = reach[:, None, None] * np.concatenate([_homography(place), -by_pq], axis=2)
        across = np.linalg.svd((self.targets_mm - pencil.focal_point_mm)[:, None])[2][:, 1:]  # (N, 2, 3), orthonormal
        return across @ plane.axes.T @ on_plane


def _on_plane(view: BeadView, frame: Frame, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the beads' rows among the view's fiducials, their places and covariances on the reference plane."""
    beads = match(seen, frame, view.name)
    if beads.covariance_px2 is None:
        raise UnusableInputError("give beads with covariances to measure a movement; these have none")
    place, slope = view.plane_map.linearised(beads.uv_px)
    return beads.rows, place, slope @ beads.covariance_px2 @ np.swapaxes(slope, 1, 2)


def _homography(place_mm: np.ndarray) -> np.ndarray:
    """Return (N, 2, 8), mm: derivatives of places (N, 2) by the parameters of a homography near identity."""
    x, y = (place_mm / _UNIT_MM).T
    ones, zero = np.ones_like(x), np.zeros_like(x)
    rows = [[ones, x, y, zero, zero, zero, x * x, x * y], [zero, zero, zero, ones, x, y, x * y, y * y]]
    return np.moveaxis(np.array(rows), 2, 0)


def _fitted(design: np.ndarray, moved_mm: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the robust fit: gain (11, used, 2), beads used (N,) bool, and variance factor (1 or more).

    Raises CalibrationRefusedError.
    """
    used, rounds = np.ones(len(design), dtype=bool), 0
    while True:
        if used.sum() < MIN_BEADS:
            raise CalibrationRefusedError(
                f"{used.sum()} usable beads are in both images; {MIN_BEADS} are needed to measure a movement"
            )
        gain, square = _solved(design, moved_mm, weight, used)
        scale = max(1.0, variance_ratio(square[used]))
        wrong = used & (square > _WRONG_M2 * scale)
        rounds += 1
        if rounds > _ROUNDS or not wrong.any():
            return gain, used, scale
        used = used & ~wrong


def _solved(
    design: np.ndarray, moved_mm: np.ndarray, weight: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain (11, used, 2) from movements to parameters, and the squared Mahalanobis residuals (N,)."""
    a, w = design[used], weight[used]
    half = np.swapaxes(a, 1, 2) @ w  # (used, 11, 2)
    normal = np.einsum("nka,nal->kl", half, a)
    gain = np.linalg.solve(normal, np.moveaxis(half, 0, 1).reshape(_PARAMETERS, -1)).reshape(_PARAMETERS, -1, 2)
    parameters = np.einsum("knb,nb->k", gain, moved_mm[used])
    residual = moved_mm - design @ parameters
    return gain, np.einsum("na,nab,nb->n", residual, weight, residual)


def _largest_sd(covariance: np.ndarray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance).max(), 0.0)))
