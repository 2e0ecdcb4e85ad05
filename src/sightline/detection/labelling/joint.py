"""Both plates of a view at once: one smooth map, one focal point, and each bead predicted by all the others."""

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

LEAST_BEYOND = 0.1  # of the distance between the plates: nearer to them no shadows are cast [ours]
FOCAL_STEP_MM = 500.0  # prior on the first guess of the focal point: wide [ours]


@dataclass(frozen=True, eq=False)
class Shadows:
    """Where the source plate's fiducials are seen on the XRII plate: `flat_mm` (S, 2), `height_mm` (S,) over it."""

    pattern: Pattern
    normal: np.ndarray
    flat_mm: np.ndarray
    height_mm: np.ndarray

    @staticmethod
    @lru_cache(maxsize=16)
    def of(xrii: Pattern, source: Pattern) -> "Shadows":
        """The shadows of one plate on the other."""
        plane = xrii.plane
        return Shadows(xrii, plane.normal, plane.to_plane(source.xyz_mm), plane.height_mm(source.xyz_mm))

    def height_of(self, xyz_mm: np.ndarray) -> float:
        """Signed distance of a point (3,) from the XRII plate."""
        return float((xyz_mm - self.pattern.plane.origin_mm) @ self.normal)

    def sees(self, focal_mm: np.ndarray) -> bool:
        """Whether a focal point (3,) lies beyond the source plate, seen from the XRII plate."""
        return bool((self.height_of(focal_mm) / self.height_mm > 1.0 + LEAST_BEYOND).all())

    def seen_from(self, focal_mm: np.ndarray) -> np.ndarray:
        """(S, 2) the shadows (central projection)."""
        return self._central(self.flat_mm, self.height_mm, focal_mm)

    def of_points(self, xyz_mm: np.ndarray, focal_mm: np.ndarray) -> np.ndarray:
        """(K, 2) the shadows of other points (K, 3)."""
        plane = self.pattern.plane
        return self._central(plane.to_plane(xyz_mm), plane.height_mm(xyz_mm), focal_mm)

    def _central(self, flat_mm: np.ndarray, height_mm: np.ndarray, focal_mm: np.ndarray) -> np.ndarray:
        share = (height_mm / (height_mm - self.height_of(focal_mm)))[:, None]  # of the focal point in the shadow
        return flat_mm + share * (self.pattern.plane.to_plane(focal_mm) - flat_mm)

    def by_focal(self, focal_mm: np.ndarray) -> np.ndarray:
        """(S, 2, 3) the derivative of the shadows by the focal point."""
        f, y = self.height_of(focal_mm), self.height_mm
        by_height = (y / (y - f) ** 2)[:, None] * (self.pattern.plane.to_plane(focal_mm) - self.flat_mm)
        return (y / (y - f))[:, None, None] * self.pattern.plane.axes + by_height[:, :, None] * self.normal


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit of both plates to beads (B, 2) of detection and place; source places follow the XRII ones.

    For all detections: `xy_mm` (N, 2) on the XRII plate, predicted without the detection itself; `variance_mm2` (N,)
    of that, with its own noise. `target_mm` (P, 2): where the places lie, source ones seen from `focal_point_mm`.
    `m2` (B,): squared distance of each bead from its place in standard deviations, by all others. `bend`: the
    largest coefficient of the map, in standard deviations of its prior: how unlike an image intensifier's it is.
    """

    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    target_mm: np.ndarray
    m2: np.ndarray
    bend: float


class Model:
    """The map from the image to the XRII plate as a Gaussian process, for the detections of one image.

    Per axis a polynomial to degree 5 and a smooth remainder; the focal point couples the axes by three numbers, so
    that its part of the inverse covariance is of rank three. `pair`: the XRII and the source plate's lattices.
    """

    def __init__(self, pair: tuple[Grown, Grown], detections: Detections) -> None:
        self.xrii, self.sheet = pair[0].pattern, pair[0].sheet
        self.shadows = Shadows.of(pair[0].pattern, pair[1].pattern)
        self.w = self.sheet.w(detections.uv_px)
        bead_mm = np.hypot(max(g.pattern.bead_sd_mm for g in pair), CENTRE_PX / self.sheet.similarity.scale)
        self.noise = self.sheet.noise(detections.covariance_px2) + (bead_mm / self.sheet.unit_mm) ** 2
        self.phi = features(self.w)[0]
        self.kernel = map_covariance(self.phi, self.phi, squared_distances(self.w, self.w))

    def first_focal_point(self, xrii: Grown, source: Grown) -> np.ndarray:
        """(3,) where the lines meet from the source beads through their images on the XRII plate.

        Raises ReconstructionRefusedError where they are parallel.
        """
        through = source.pattern.xyz_mm[source.places]
        return meeting_point(through, through - self.xrii.plane.to_space(xrii.xy_mm[source.rows])).point_mm

    def fit(self, beads: np.ndarray, focal_mm: np.ndarray, factor: float) -> Joint:
        """One Gauss-Newton step from `focal_mm`; `factor` scales the variance of the noise."""
        rows, places = beads[:, 0], beads[:, 1]
        count, unit = len(self.xrii.ids), self.sheet.unit_mm
        of_source = np.flatnonzero(places >= count)
        y = (self._targets(focal_mm)[places] - self.sheet.centre_mm) / unit - self.w[rows]
        by_focal = np.zeros((len(rows), 2, 3))
        by_focal[of_source] = self.shadows.by_focal(focal_mm)[places[of_source] - count] * (FOCAL_STEP_MM / unit)
        noise = factor * self.noise
        covariance = self.kernel[rows][:, rows]
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
        """(P, 2) mm: where the places lie on the XRII plate, source ones seen from a focal point."""
        return np.concatenate([self.xrii.xy_mm, self.shadows.seen_from(focal_mm)])
