"""Joint fit of both plates of a view: one smooth map, one focal point, and leave-one-out predictions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.map_prior import CENTRE_PX, features, map_covariance
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections
from sightline.fitting.kernels import squared_distances
from sightline.fitting.kriging import PlanarKriging
from sightline.geometry.lines import meeting_point

MIN_BEYOND = 0.1  # smallest distance of the focal point beyond the source plate, over that between the plates [ours]
FOCAL_STEP_MM = 500.0  # wide prior s.d. of the focal point's step [ours]


@dataclass(frozen=True, eq=False)
class Shadows:
    """The source plate's fiducials, `height_mm` (S,) above `flat_mm` (S, 2) on the XRII plate, projected onto it."""

    pattern: Pattern
    normal: np.ndarray
    flat_mm: np.ndarray
    height_mm: np.ndarray

    @staticmethod
    @lru_cache(maxsize=16)
    def of(xrii: Pattern, source: Pattern) -> "Shadows":
        """Return the shadows of the source plate on the XRII plate."""
        plane = xrii.plane
        return Shadows(xrii, plane.normal, plane.to_plane(source.xyz_mm), plane.height_mm(source.xyz_mm))

    @staticmethod
    def none(plate: Pattern) -> "Shadows":
        """Return the shadows of no source plate."""
        return Shadows(plate, plate.plane.normal, np.zeros((0, 2)), np.zeros(0))

    def height_of(self, xyz_mm: np.ndarray) -> float:
        """Return the signed distance of a point (3,) from the XRII plate."""
        return float((xyz_mm - self.pattern.plane.origin_mm) @ self.normal)

    def sees(self, focal_mm: np.ndarray) -> bool:
        """Return whether a focal point (3,) lies beyond the source plate, seen from the XRII plate."""
        return bool((self.height_of(focal_mm) / self.height_mm > 1.0 + MIN_BEYOND).all())

    def seen_from(self, focal_mm: np.ndarray) -> np.ndarray:
        """Return the shadows (S, 2), mm, by central projection."""
        return self._central(self.flat_mm, self.height_mm, focal_mm)

    def of_points(self, xyz_mm: np.ndarray, focal_mm: np.ndarray) -> np.ndarray:
        """Return the shadows (K, 2), mm, of other points (K, 3)."""
        plane = self.pattern.plane
        return self._central(plane.to_plane(xyz_mm), plane.height_mm(xyz_mm), focal_mm)

    def _central(self, flat_mm: np.ndarray, height_mm: np.ndarray, focal_mm: np.ndarray) -> np.ndarray:
        share = (height_mm / (height_mm - self.height_of(focal_mm)))[:, None]  # weight of the focal point in the shadow
        return flat_mm + share * (self.pattern.plane.to_plane(focal_mm) - flat_mm)

    def by_focal(self, focal_mm: np.ndarray) -> np.ndarray:
        """Return the derivative (S, 2, 3) of the shadows by the focal point."""
        f, y = self.height_of(focal_mm), self.height_mm
        by_height = (y / (y - f) ** 2)[:, None] * (self.pattern.plane.to_plane(focal_mm) - self.flat_mm)
        return (y / (y - f))[:, None, None] * self.pattern.plane.axes + by_height[:, :, None] * self.normal


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit of both plates, or of one alone, to beads (B, 2) of detection and place; source places follow XRII ones.

    For all N detections: `xy_mm` (N, 2) on the XRII plate, predicted without the detection itself, and its variance
    `variance_mm2` (N,), with the detection's noise. `target_mm` (P, 2): the places on the XRII plate, source ones
    projected from `focal_point_mm`. `m2` (B,): squared leave-one-out Mahalanobis distance of each bead from its place.
    `bend`: largest coefficient of the map in s.d. of its prior, a measure of implausible distortion.
    """

    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    target_mm: np.ndarray
    m2: np.ndarray
    bend: float


class Model:
    """The Gaussian-process map from the image to the XRII plate, for the detections of one image.

    Each axis has a polynomial of degree 5 and a smooth remainder. The focal point's three coordinates couple the axes,
    so its part of the inverse covariance has rank three. `pair`: the XRII and the source plate's lattices, or that of
    one plate alone, which has no focal point.
    """

    def __init__(self, pair: Sequence[Grown], detections: Detections) -> None:
        self.xrii, self.sheet = pair[0].pattern, pair[0].sheet
        self.shadows = Shadows.of(pair[0].pattern, pair[1].pattern) if len(pair) > 1 else Shadows.none(pair[0].pattern)
        self.w = self.sheet.w(detections.uv_px)
        bead_mm = np.hypot(max(g.pattern.bead_sd_mm for g in pair), CENTRE_PX / self.sheet.similarity.scale)
        self.noise = self.sheet.noise(detections.covariance_px2) + (bead_mm / self.sheet.unit_mm) ** 2
        self.phi = features(self.w)[0]
        self.kernel = map_covariance(self.phi, self.phi, squared_distances(self.w, self.w))

    def first_focal_point(self, xrii: Grown, source: Grown) -> np.ndarray:
        """Return the intersection (3,) of the lines from the source beads through their images on the XRII plate.

        Raises ReconstructionRefusedError where they are parallel.
        """
        through = source.pattern.xyz_mm[source.places]
        return meeting_point(through, through - self.xrii.plane.to_space(xrii.xy_mm[source.rows])).point_mm

    def fit(self, beads: np.ndarray, focal_mm: np.ndarray, factor: float) -> Joint:
        """Return the fit after one Gauss-Newton step from `focal_mm`; `factor` scales the variance of the noise."""
        rows, places = beads[:, 0], beads[:, 1]
        count, unit = len(self.xrii.ids), self.sheet.unit_mm
        of_source = np.flatnonzero(places >= count)
        y = (self._targets(focal_mm)[places] - self.sheet.centre_mm) / unit - self.w[rows]
        by_focal = np.zeros((len(rows), 2, 3))
        by_focal[of_source] = self.shadows.by_focal(focal_mm)[places[of_source] - count] * (FOCAL_STEP_MM / unit)
        noise = factor * self.noise
        covariance = self.kernel.take(rows, 0).take(rows, 1)
        covariance.flat[:: len(rows) + 1] += noise[rows]
        solution = PlanarKriging.of(covariance, y, columns=by_focal, precision=np.eye(3))
        focal = focal_mm - FOCAL_STEP_MM * solution.shared
        target_mm = self._targets(focal)
        xy_mm, variance = np.empty((len(self.w), 2)), np.empty(len(self.w))

        others = solution.left_out()
        xy_mm[rows] = target_mm[places] - others.residual * unit
        variance[rows] = others.variance

        loose = np.ones(len(self.w), dtype=bool)
        loose[rows] = False
        kernel = self.kernel[loose][:, rows]
        prior = self.kernel.diagonal()[loose] + noise[loose]
        xy_mm[loose] = (self.w[loose] + kernel @ solution.dual) * unit + self.sheet.centre_mm
        variance[loose] = solution.variances(kernel, prior)
        bend = float(np.abs(self.phi[rows].T @ solution.dual).max())
        return Joint(focal, xy_mm, variance * unit**2, target_mm, others.m2, bend)

    def _targets(self, focal_mm: np.ndarray) -> np.ndarray:
        """Return the places (P, 2), mm, on the XRII plate, source ones projected from a focal point."""
        return np.concatenate([self.xrii.xy_mm, self.shadows.seen_from(focal_mm)])
