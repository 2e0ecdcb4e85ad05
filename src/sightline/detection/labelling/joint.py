"""Joint fit of both plates of a view: one smooth map, one focal point, and leave-one-out predictions.

Fits are in the sheet's coordinates: places and focal point are (x, y, height) over the XRII plate, from the field's
centre in units of its radius. Only labels follow from these numbers, no estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sightline.common.fitting import (
    MEDIAN_M2,
    cholesky,
    exact_squares,
    inverse_lower,
    median,
    squared_distances,
)
from sightline.common.geometry.lines import SPREAD_RAD
from sightline.detection.labelling.growth import CENTRE_PX, Grown, features, map_covariance
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.results import Detections

MIN_BEADS = 8  # [ours] of each plate: with fewer, a wrong labelling may fit as well
# Smallest distance of the focal point beyond the source plate, over that between the plates [ours]: nearer, the C-arm's
# own housing would touch the plate.
MIN_BEYOND = 0.1
GATE_M2 = 11.3  # squared Mahalanobis distance in place and radius: 99 % of chi-square, 3 degrees of freedom [calc]
NEAR_M2 = 24.0  # [ours] detections or places as near as this can be confused with each other: twice the gate and more
MAX_FITS, NOISE_FITS = 10, 3  # iterations, and those in which the noise is estimated
SAME_NOISE = 0.1  # [ours] relative change of the noise that needs no further fit: its estimate is no better
MAX_NOISE = 100.0  # times the stated variance; rendered images have up to 3.5, and 1 would lose 7 % of the beads [twin]
SAME_DISTANCE = 1e-6  # relative, of two squares that rounding alone tells apart
FOCAL_STEP_MM = 500.0  # [ours] prior s.d. of the focal point's step: wide, so that only runaway steps are held back


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
        plane = self.xrii.plane
        places = Places((self.shadows.xyh_mm - centre) / unit, len(self.xrii.ids), FOCAL_STEP_MM / unit)
        at = (self.xy_mm - self.sheet.centre_mm) / unit
        fit = settle(Spots(self.w, self.kernel, self.noise, size_m2, usable), places, at, on)
        if fit is None:
            return None
        on = fit.on
        rows = np.flatnonzero(on >= 0)
        return Joint(
            beads=np.stack([rows, on[rows]], axis=1),
            focal_point_mm=plane.origin_mm + (fit.focal * unit + centre) @ plane.basis,
            xy_mm=fit.at * unit + self.sheet.centre_mm,
            variance_mm2=fit.variance * unit**2,
            target_mm=fit.target * unit + self.sheet.centre_mm,
            bend=float(np.abs(self.phi.T @ fit.dual).max()),
        )


class Spots(NamedTuple):
    """N detections: sheet coordinates `w` (N, 2), prior covariance of the map there, `kernel` (N, N), `noise` (N,).

    `size_m2` (N, P): squared misfit of each detection's radius on each place; `usable` (N,) bool.
    """

    w: np.ndarray
    kernel: np.ndarray
    noise: np.ndarray
    size_m2: np.ndarray
    usable: np.ndarray


class Places(NamedTuple):
    """P places `xyh` (P, 3), those of the XRII plate, `on_xrii` of them, before those of the source plate.

    `focal_sd`: prior s.d. per axis of the focal point's step.
    """

    xyh: np.ndarray
    on_xrii: int
    focal_sd: float

    def seen_by(self, focal: np.ndarray) -> bool:
        """Return whether a focal point lies beyond the source plate, seen from the XRII plate."""
        return bool((focal[2] / self.xyh[self.on_xrii :, 2] > 1.0 + MIN_BEYOND).all())

    def projected(self, focal: np.ndarray) -> np.ndarray:
        """Return the places (P, 2) projected from a focal point; those of the XRII plate have no height."""
        share = self.xyh[:, 2:] / (self.xyh[:, 2:] - focal[2])
        return self.xyh[:, :2] + share * (focal[:2] - self.xyh[:, :2])

    def fewest(self, on: np.ndarray) -> int:
        """Return the smaller number of beads of one plate, of beads on places `on` (N,), or -1."""
        xrii, source = int(((on >= 0) & (on < self.on_xrii)).sum()), int((on >= self.on_xrii).sum())
        return xrii if self.on_xrii == len(self.xyh) else min(xrii, source)


class Fitted(NamedTuple):
    """A fit to beads `on` (N,) places, or -1: `focal` (3,), and of every detection `at` (N, 2) and `variance` (N,).

    They are predicted without the detection itself; the variance is that of either coordinate, with its noise.
    `target` (P, 2): the places projected from `focal`. `dual` (N, 2): the map less identity is kernel @ dual. `m2`:
    squared leave-one-out Mahalanobis distances of the beads.
    """

    on: np.ndarray
    focal: np.ndarray
    at: np.ndarray
    variance: np.ndarray
    target: np.ndarray
    dual: np.ndarray
    m2: np.ndarray


def settle(spots: Spots, places: Places, at: np.ndarray, on: np.ndarray) -> Fitted | None:
    """Fit and match in turns until beads and noise stay, beginning with the places `on` (N,) of the detections, or -1.

    Begin at `first_focal` of `at` (N, 2). None where the fit does not settle, or too few beads are left.
    """
    focal, growth = first_focal(places, at, on), 1.0
    for iteration in range(MAX_FITS if places.seen_by(focal) else 0):
        fit, before = _fitted(on, spots, places, focal, growth), growth
        if fit is None:
            return None
        focal = fit.focal
        if iteration < NOISE_FITS:  # later, gating has cut off the tails, and the noise would be underestimated
            growth = min(max(growth * median(fit.m2) / MEDIAN_M2, 1.0), MAX_NOISE)
        new = _matched(fit, growth / before, spots)
        if iteration >= NOISE_FITS:  # from here beads are only removed, so the loop terminates
            new[new != on] = -1
        if iteration and np.array_equal(new, on) and abs(growth - before) < SAME_NOISE * before:
            return fit
        on = new
        if places.fewest(on) < MIN_BEADS or not places.seen_by(focal):
            return None
    return None


def first_focal(places: Places, at: np.ndarray, on: np.ndarray) -> np.ndarray:
    """Return the point (3,) nearest to the lines from the source beads through their images on the XRII plate.

    `at` (N, 2): the detections, mapped to the XRII plate; `on` (N,): their places, or -1. The origin, which
    `Places.seen_by` refuses, if the lines are nearly parallel; with one plate any point.
    """
    if places.on_xrii == len(places.xyh):
        return np.array([0.0, 0.0, 1.0])
    beads = on >= places.on_xrii
    source = places.xyh[on[beads]]
    along = source.copy()
    along[:, :2] -= at[beads]
    square = (along**2).sum(axis=1)
    foot = source - ((source * along).sum(axis=1) / square)[:, None] * along  # nearest to the origin
    normal = len(source) * np.eye(3) - (along / square[:, None]).T @ along
    try:
        if cholesky(normal)[2, 2] ** 2 < len(source) * SPREAD_RAD**2:
            return np.zeros(3)
    except np.linalg.LinAlgError:
        return np.zeros(3)
    return np.linalg.solve(normal, foot.sum(axis=0))


def _fitted(on: np.ndarray, spots: Spots, places: Places, focal: np.ndarray, growth: float) -> Fitted | None:
    """Return the fit to the beads `on` (N,) after one Gauss-Newton step from `focal`; None if it is not determined.

    V is the covariance of either coordinate. The derivatives of a bead's coordinates by the focal point are (s, 0, g_x)
    and (0, s, g_y), so that five vectors determine the fit: x, y, s, g_x and g_y. `growth`: of the noise.
    """
    rows, others = np.flatnonzero(on >= 0), np.flatnonzero(on < 0)
    place, target = on[rows], places.projected(focal)
    xyh, height = places.xyh[place], places.xyh[place, 2] - focal[2]
    s = places.focal_sd * xyh[:, 2] / height
    slopes = [s * (focal[c] - xyh[:, c]) / height for c in (0, 1)]
    vectors = np.stack([*(target[place] - spots.w[rows]).T, s, *slopes])
    try:
        inverse = inverse_lower(cholesky(spots.kernel[np.ix_(rows, rows)] + np.diag(growth * spots.noise[rows])))
    except np.linalg.LinAlgError:
        return None
    white = inverse @ vectors.T
    solved, products = (inverse.T @ white).T, white.T @ white
    u, v, a, bx, by = solved
    information = np.diag([1.0 + products[2, 2], 1.0 + products[2, 2], 1.0 + products[3, 3] + products[4, 4]])
    information[2, :2] = information[:2, 2] = products[2, 3:]
    covariance = np.linalg.inv(information)
    spread = np.linalg.cholesky(covariance)
    step = covariance @ [products[0, 2], products[1, 2], products[0, 3] + products[1, 4]]
    u -= a * step[0] + bx * step[2]
    v -= a * step[1] + by * step[2]
    focal = focal - places.focal_sd * step
    target = places.projected(focal)

    # Of the beads, each without itself: the blocks of the inverse covariance, less the focal point's part.
    x, y = np.outer(a, spread[0]) + np.outer(bx, spread[2]), np.outer(a, spread[1]) + np.outer(by, spread[2])
    own = (inverse**2).sum(axis=0)
    xx, xy, yy = own - (x**2).sum(axis=1), -(x * y).sum(axis=1), own - (y**2).sum(axis=1)
    det = xx * yy - xy * xy
    off = np.stack([(yy * u - xy * v) / det, (xx * v - xy * u) / det], axis=1)
    at, variance, dual = np.empty(spots.w.shape), np.empty(len(on)), np.zeros(spots.w.shape)
    at[rows], variance[rows], dual[rows] = target[place] - off, (xx + yy) / (2 * det), solved[:2].T

    cross = spots.kernel[np.ix_(others, rows)]
    sums = cross @ solved.T
    x = np.outer(sums[:, 2], spread[0]) + np.outer(sums[:, 3], spread[2])
    y = np.outer(sums[:, 2], spread[1]) + np.outer(sums[:, 4], spread[2])
    at[others] = spots.w[others] + sums[:, :2]
    variance[others] = spots.kernel[others, others] + growth * spots.noise[others]
    variance[others] += (x**2 + y**2).sum(axis=1) / 2 - ((cross @ inverse.T) ** 2).sum(axis=1)
    return Fitted(on, focal, at, variance, target, dual, u * off[:, 0] + v * off[:, 1])


def _matched(fit: Fitted, growth: float, spots: Spots) -> np.ndarray:
    """Return the place (N,) of each usable detection within the gate, or -1 where there is none or several.

    `growth`: of the fit's variances.
    """
    m2 = exact_squares(fit.at, fit.target) / (growth * fit.variance)[:, None] + spots.size_m2
    near = spots.usable[:, None] & (m2 < NEAR_M2)
    alone = near & (near.sum(axis=1) == 1)[:, None] & (near.sum(axis=0) == 1) & (m2 < GATE_M2)
    return np.where(alone.any(axis=1), alone.argmax(axis=1), -1)


def empty_near(target: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """Return the share (B,) of places near each of `places` (B,) that are not among these, with one more of each kind.

    `target` (P, 2). Near are the `count` nearest ones and all that are as far as the last of them but for rounding: on
    a grid there are several, and rounding must not choose among them.
    """
    free = np.ones(len(target), bool)
    free[places] = False
    off2 = exact_squares(target[places], target)
    off2[np.arange(len(places)), places] = np.inf
    near = off2 < (1.0 + SAME_DISTANCE) * np.partition(off2, min(count, len(target)) - 1, axis=1)[:, [count - 1]]
    return (np.count_nonzero(near & free, axis=1) + 1.0) / (np.count_nonzero(near, axis=1) + 2.0)
