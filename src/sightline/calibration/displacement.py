"""How far a target's lines of sight have moved, against the frame, between two images taken with it.

The frame's errors and those of the map are the same in both images and cancel; what is left is the noise of the beads'
centres. Distortion is taken to have stayed: then a new place of the C-arm is, on the reference plane, a homography of
where pixels were (8 numbers) and another focal point (3), whatever moved: frame, C-arm, source against detector. These
11 numbers, and by them the movement of the lines at a target, follow from the beads by weighted least squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.calibration.bead_view import BeadView
from sightline.calibration.beads import match
from sightline.calibration.joint import JointFit
from sightline.detection.results import Observations
from sightline.errors import CalibrationRefusedError, UnusableInputError
from sightline.fitting.robust import variance_ratio
from sightline.frame import Frame

MIN_BEADS = 12  # of 11 numbers, two equations each, and some to spare [ours]
_NUMBERS = 11
_UNIT_MM = 100.0  # of the plane's coordinates in the homography, so that its numbers are alike [calc]
_WRONG_M2 = 13.8  # chi-square, two degrees of freedom, once in 1,000: an instrument in front of a bead
_ROUNDS = 3  # of leaving out wrong beads


@dataclass(frozen=True, eq=False)
class Displacement:
    """Of the lines of sight of T targets, at the targets, across the beam, mm.

    `shift_mm` (T, 2): along two axes across the line; `covariance_mm2` (T, 2, 2): of this image's beads; `rest_mm2`
    (T, 2, 2): of the image at rest, the same for every image compared with it. `beads`: how many it rests on.
    """

    shift_mm: np.ndarray
    covariance_mm2: np.ndarray
    rest_mm2: np.ndarray
    beads: int

    @property
    def length_mm(self) -> float:
        """The largest of the targets."""
        return float(np.hypot(*self.shift_mm.T).max())

    @property
    def sd_mm(self) -> float:
        """The largest of this image, over targets and directions."""
        return _largest_sd(self.covariance_mm2)

    @property
    def rest_sd_mm(self) -> float:
        """The largest of the image at rest."""
        return _largest_sd(self.rest_mm2)


@dataclass(frozen=True, eq=False)
class Rest:
    """Where the beads are while nothing moves, as one calibrated view of the smooth method has them.

    `place_mm` (M, 2) and `covariance_mm2` (M, 2, 2), for every fiducial of the view in the frame's order: on the
    reference plane; not finite where the fiducial was not seen. `targets_mm` (T, 3) CFCS.
    """

    frame: Frame
    view: BeadView
    fit: JointFit
    place_mm: np.ndarray
    covariance_mm2: np.ndarray
    targets_mm: np.ndarray

    @staticmethod
    def of(view: BeadView, frame: Frame, seen: Sequence[Observations], targets_mm: np.ndarray) -> "Rest":
        """The mean of one or more images' beads. Raises UnusableInputError, and as `match` does."""
        if not isinstance(view.posterior, JointFit):
            raise UnusableInputError("movements are told by the smooth method's views only; calibrate with 'smooth'")
        each = np.full((2, len(seen), len(frame.view(view.name).fiducials), 2, 2), np.nan)
        for k, one in enumerate(seen):
            rows, place, covariance = _on_plane(view, frame, one)
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
        """Of an image's beads against these. Raises CalibrationRefusedError where too few beads are in both."""
        rows, place, covariance = _on_plane(self.view, self.frame, seen)
        both = np.isfinite(self.place_mm[rows, 0])
        rows, place, covariance = rows[both], place[both], covariance[both]
        fiducials = self.frame.view(self.view.name)
        xyz = np.concatenate([fiducials.xrii.xyz_mm, fiducials.source.xyz_mm])[rows]
        gap, at_rest = place - self.place_mm[rows], self.covariance_mm2[rows]
        design, to_target = self._design(xyz, self.place_mm[rows]), self._at_targets()
        gain, used, scale = _agreed(design, gap, np.linalg.inv(covariance + at_rest))
        response = np.einsum("tak,knb->tanb", to_target, gain)
        numbers = np.einsum("tanb,nb->ta", response, gap[used])
        own, rest = (
            scale * np.einsum("tanb,nbc,tdnc->tad", response, c[used], response) for c in (covariance, at_rest)
        )
        return Displacement(numbers, own, rest, int(used.sum()))

    def _design(self, xyz_mm: np.ndarray, place_mm: np.ndarray) -> np.ndarray:
        """(N, 2, 11): how a bead's place moves with the homography and with the focal point."""
        return np.concatenate([-_homography(place_mm), self.fit.pencil.by_pq(xyz_mm)], axis=2)

    def _at_targets(self) -> np.ndarray:
        """(T, 2, 11): how the line of sight of a target moves there, across itself."""
        pencil, plane = self.fit.pencil, self.fit.pencil.plane
        place, by_pq = pencil.linearised(self.targets_mm)
        reach = 1.0 - plane.height_mm(self.targets_mm) * pencil.pq[2]
        on_plane = reach[:, None, None] * np.concatenate([_homography(place), -by_pq], axis=2)
        across = np.array([_across(target - pencil.focal_point_mm) for target in self.targets_mm])
        return across @ plane.axes.T @ on_plane


def _on_plane(view: BeadView, frame: Frame, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows among the view's fiducials, places and covariances on the reference plane, of an image's beads."""
    beads = match(seen, frame, view.name)
    if beads.covariance_px2 is None:
        raise UnusableInputError("a movement is told from beads with covariances; these have none")
    place, slope = view.plane_map.linearised(beads.uv_px)
    return beads.rows, place, slope @ beads.covariance_px2 @ np.swapaxes(slope, 1, 2)


def _homography(place_mm: np.ndarray) -> np.ndarray:
    """(N, 2, 8): how places (N, 2) on a plane move with the numbers of a homography near identity, mm."""
    x, y = (place_mm / _UNIT_MM).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = [[one, x, y, none, none, none, x * x, x * y], [none, none, none, one, x, y, x * y, y * y]]
    return np.moveaxis(np.array(rows), 2, 0)


def _agreed(design: np.ndarray, gap_mm: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The gain, (11, used, 2), of the beads that agree on the 11 numbers; which these are, (N,) bool; by what their
    gaps' variance exceeds what is stated. Raises CalibrationRefusedError."""
    used, rounds = np.ones(len(design), dtype=bool), 0
    while True:
        if used.sum() < MIN_BEADS:
            raise CalibrationRefusedError(
                f"{used.sum()} beads are in both images; {MIN_BEADS} are needed to tell a movement"
            )
        gain, square = _solved(design, gap_mm, weight, used)
        scale = max(1.0, variance_ratio(square[used]))
        wrong = used & (square > _WRONG_M2 * scale)
        rounds += 1
        if rounds > _ROUNDS or not wrong.any():
            return gain, used, scale
        used = used & ~wrong


def _solved(
    design: np.ndarray, gap_mm: np.ndarray, weight: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(11, used, 2): by which the numbers follow from the gaps; (N,): what is left of each, squared, in variances."""
    a, w = design[used], weight[used]
    half = np.swapaxes(a, 1, 2) @ w  # (used, 11, 2)
    normal = np.einsum("nka,nal->kl", half, a)
    gain = np.linalg.solve(normal, np.moveaxis(half, 0, 1).reshape(_NUMBERS, -1)).reshape(_NUMBERS, -1, 2)
    numbers = np.einsum("knb,nb->k", gain, gap_mm[used])
    left = gap_mm - design @ numbers
    return gain, np.einsum("na,nab,nb->n", left, weight, left)


def _across(direction: np.ndarray) -> np.ndarray:
    """(2, 3): unit vectors across a direction (3,)."""
    return np.linalg.svd(direction[None])[2][1:]


def _largest_sd(covariance: np.ndarray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance).max(), 0.0)))
