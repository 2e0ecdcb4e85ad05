"""Joint fit of both plates of a view: one smooth map, one focal point, and leave-one-out predictions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sightline.detection.labelling.growth import Grown
from sightline.detection.labelling.joint_kernels import Places, Spots, settle
from sightline.detection.labelling.map_prior import CENTRE_PX, features, map_covariance
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections
from sightline.fitting.kernels import squared_distances

FOCAL_STEP_MM = 500.0  # wide prior s.d. of the focal point's step [ours]


@dataclass(frozen=True, eq=False)
class Shadows:
    """The plates' fiducials over the XRII plate, of `pattern`.

    `xyh_mm` (P, 3): place and height, source fiducials after XRII ones.
    """

    pattern: Pattern
    xyh_mm: np.ndarray

    @staticmethod
    @lru_cache(maxsize=16)
    def of(xrii: Pattern, source: Pattern | None) -> "Shadows":
        """Return the shadows of the source plate, if there is one, on the XRII plate, whose own have no height."""
        xyh = np.column_stack([xrii.xy_mm, np.zeros(len(xrii.xy_mm))])
        if source is not None:
            plane = xrii.plane
            xyh = np.vstack([xyh, np.column_stack([plane.to_plane(source.xyz_mm), plane.height_mm(source.xyz_mm)])])
        return Shadows(xrii, xyh)

    @property
    def side(self) -> float:
        """The sign of the source plate's height: on which side of the XRII plate it lies, seen along the normal."""
        return float(np.sign(self.xyh_mm[:, 2].sum()))

    def of_points(self, xyz_mm: np.ndarray, focal_mm: np.ndarray) -> np.ndarray:
        """Return the shadows (K, 2), mm, of other points (K, 3)."""
        plane = self.pattern.plane
        flat, height = plane.to_plane(xyz_mm), plane.height_mm(xyz_mm)
        share = (height / (height - plane.height_mm(focal_mm)))[:, None]  # weight of the focal point in the shadow
        return flat + share * (plane.to_plane(focal_mm) - flat)


@dataclass(frozen=True, eq=False)
class Joint:
    """A fit of both plates, or of one alone, to `beads` (B, 2) of detection and place; source places follow XRII ones.

    For all N detections: `xy_mm` (N, 2) on the XRII plate, predicted without the detection itself, and its variance
    `variance_mm2` (N,), with the detection's noise. `target_mm` (P, 2): the places on the XRII plate, source ones
    projected from `focal_point_mm`. `bend`: largest coefficient of the map in s.d. of its prior, a measure of
    implausible distortion.
    """

    beads: np.ndarray
    focal_point_mm: np.ndarray
    xy_mm: np.ndarray
    variance_mm2: np.ndarray
    target_mm: np.ndarray
    bend: float


class Model:
    """The Gaussian-process map from the image to the XRII plate, for the detections of one image.

    Each axis has a polynomial of degree 5 and a smooth remainder. The focal point's three coordinates couple the axes,
    so its part of the inverse covariance has rank three. `pair`: the XRII and the source plate's lattices, or that of
    one plate alone, which has no focal point.
    """

    def __init__(self, pair: Sequence[Grown], detections: Detections) -> None:
        self.xrii, self.sheet, self.xy_mm = pair[0].pattern, pair[0].sheet, pair[0].xy_mm
        self.shadows = Shadows.of(*(g.pattern for g in pair), *([None] if len(pair) == 1 else []))
        self.w = self.sheet.w(detections.uv_px)
        bead_mm = np.hypot(max(g.pattern.bead_sd_mm for g in pair), CENTRE_PX / self.sheet.similarity.scale)
        self.noise = self.sheet.noise(detections.covariance_px2) + (bead_mm / self.sheet.unit_mm) ** 2
        self.phi = features(self.w)[0]
        self.kernel = map_covariance(self.phi, self.phi, squared_distances(self.w, self.w))

    def settled(self, on: np.ndarray, size_m2: np.ndarray, usable: np.ndarray) -> Joint | None:
        """Return the fit to the beads that it explains, from the place `on` (N,) of each detection, or -1.

        None where too few are explained, or the beads of two plates are not seen from one point. `size_m2` (N, P):
        squared misfit of each detection's radius on each place, in standard deviations.
        """
        unit, centre = self.sheet.unit_mm, np.append(self.sheet.centre_mm, 0.0)
        plane, on = self.xrii.plane, on.copy()
        places = Places((self.shadows.xyh_mm - centre) / unit, len(self.xrii.ids), FOCAL_STEP_MM / unit)
        at = (self.xy_mm - self.sheet.centre_mm) / unit
        fit, settled = settle(Spots(self.w, self.kernel, self.noise, size_m2, usable), places, at, on)
        if not settled:
            return None
        rows = np.flatnonzero(on >= 0)
        return Joint(
            beads=np.stack([rows, on[rows]], axis=1),
            focal_point_mm=plane.origin_mm + (fit.focal * unit + centre) @ plane.basis,
            xy_mm=fit.at * unit + self.sheet.centre_mm,
            variance_mm2=fit.variance * unit**2,
            target_mm=fit.target * unit + self.sheet.centre_mm,
            bend=float(np.abs(self.phi.T @ fit.dual).max()),
        )
