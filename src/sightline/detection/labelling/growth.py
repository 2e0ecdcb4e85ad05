"""Grow a seed of three beads to all beads of a plate: predict, match, fit again, outward from the seed."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.common.fitting import (
    cholesky,
    exact_squares,
    median,
    solve_lower,
    solve_lower_transposed,
    squared_exponential,
)
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, Similarity
from sightline.detection.results import Detections

DEGREE = 5
# Prior s.d. of what a map adds to a similarity, per degree, as a share of the field's radius: position, tilt and scale,
# perspective of a 20° tilt, 9 % pincushion with 4° S-shape, and their higher terms [physics.md, Distortion].
PRIOR = np.array([0.3, 0.15, 0.06, 0.10, 0.03, 0.03])
# The remainder beyond degree 5, in shares of the field's radius: 0.11-0.13 mm rms and 30-60 mm of 107 (physics.md).
REMAINDER_SD, REMAINDER_LENGTH = 0.0013, 0.4
# S.d. of a centre's error in addition to its stated noise, from uneven background and overlap: in 78 rendered images
# at high dose, the estimated noise is 1.7 times the stated variance with it, 2.1 times without it [twin].
CENTRE_PX = 0.05

_POWERS = np.array([(d - k, k) for d in range(DEGREE + 1) for k in range(d + 1)])
_SD = PRIOR[_POWERS.sum(axis=1)]


def features(w: np.ndarray) -> np.ndarray:
    """Return monomials to degree 5 of (N, 2) times their prior s.d., and their two derivatives (3, N, 21)."""
    x, y = (np.vander(values, DEGREE + 1, increasing=True) for values in w.T)
    i, j = _POWERS.T
    by_x, by_y = i * x[:, np.maximum(i - 1, 0)] * y[:, j], j * x[:, i] * y[:, np.maximum(j - 1, 0)]
    return np.stack([x[:, i] * y[:, j], by_x, by_y]) * _SD


def map_covariance(phi_a: np.ndarray, phi_b: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return the prior covariance (N, M) of a map's coordinate between points a and b, in units of the field's radius.

    `phi_a` (N, 21), `phi_b` (M, 21): their `features`; `squares` (N, M): their squared distances.
    """
    return phi_a @ phi_b.T + REMAINDER_SD**2 * squared_exponential(squares, REMAINDER_LENGTH)


REMAINDER = 0.003  # s.d. beyond degree 5, share of the radius: thrice that of tubes [physics.md, Distortion]
# Gates of the matching [ours]: standard deviations, outside of which one bead in 450 lies; and in pitches: where that
# gate is wider than CERTAIN, beads are not matched yet, since two might be in it; AGREES, the gate of the first matches
# by the seed's similarity; LOOSE, an s.d. that is added in the first fit of the map, for what the similarity leaves
# out.
GATE = 3.5
CERTAIN, AGREES, LOOSE = 0.3, 0.15, 0.1
LOG_RADIUS = 0.15  # largest error of a bead's log radius, below half the step from 3 to 5 mm, 0.26 [calc]
MAX_ROUNDS = 15


@dataclass(frozen=True, eq=False)
class Field:
    """The circle that contains an image's beads: distortion is a function of the position in it, not of the crop."""

    centre_px: np.ndarray
    radius_px: float

    @staticmethod
    def of(uv_px: np.ndarray) -> "Field":
        """Return the smallest circle around detections (N, 2)."""
        (u, v), radius = cv2.minEnclosingCircle(uv_px.astype(np.float32))
        return Field(np.array([u, v]), radius)


@dataclass(frozen=True, eq=False)
class Sheet:
    """Image coordinates mapped to a plate by a similarity: w, from the field's centre in units of `unit_mm`."""

    similarity: Similarity
    centre_mm: np.ndarray
    unit_mm: float

    @staticmethod
    def of(similarity: Similarity, field: "Field") -> "Sheet":
        """Return the sheet whose unit is the field's radius."""
        centre = similarity.to_plate(field.centre_px[None])[0]
        return Sheet(similarity, centre, field.radius_px / similarity.scale)

    def w(self, uv_px: np.ndarray) -> np.ndarray:
        """Return sheet coordinates (N, 2), within about ±1, of pixels (N, 2)."""
        return (self.similarity.to_plate(uv_px) - self.centre_mm) / self.unit_mm

    def noise(self, covariance_px2: np.ndarray) -> np.ndarray:
        """Return the variance (N,) per axis of the detections, in units²."""
        return (covariance_px2[:, 0, 0] + covariance_px2[:, 1, 1]) / 2 / (self.similarity.scale * self.unit_mm) ** 2


@dataclass(frozen=True, eq=False)
class Grown:
    """One plate's beads: detections `rows` are its fiducials `places`; `all_rows`, `all_places`: regardless of size.

    For all detections: `xy_mm` (N, 2), mapped to the plate; `log_ratio` (N,), log radius in mm on the plate, scaled
    so that the median bead of the plate has its true radius. `level`: log of that scale, detected over true radius.
    """

    pattern: Pattern
    sheet: Sheet
    rows: np.ndarray
    places: np.ndarray
    all_rows: np.ndarray
    all_places: np.ndarray
    xy_mm: np.ndarray
    log_ratio: np.ndarray
    level: float

    def __len__(self) -> int:
        return len(self.rows)


def grow(seed: Seed, detections: Detections, usable: np.ndarray) -> Grown:
    """Return the beads of the seed's plate that one smooth map explains. `usable` (N,): detections to match."""
    pattern, search = seed.pattern, _Search.of(seed, detections, usable)
    seeded = np.full(len(detections), -1)
    seeded[seed.rows] = seed.places
    level = search.level(search.log_radius, seeded)
    at, ratio = search.w, search.log_radius - level
    place_of = search.matched(at, ratio, np.full(len(at), AGREES * search.pitch), LOG_RADIUS)
    place_of[np.isin(place_of, seed.places)] = -1  # seed assignments take precedence
    place_of[seed.rows] = seed.places
    loose, reach = search.noise + (LOOSE * search.pitch) ** 2, np.zeros(len(at))
    for iteration in range(MAX_ROUNDS):
        at, ratio, reach = search.mapped(place_of, search.noise if iteration else loose)
        level = search.level(ratio, place_of)
        ratio = ratio - level
        reach[reach > CERTAIN * search.pitch] = 0.0
        before, matched = place_of, search.matched(at, ratio, reach, LOG_RADIUS)
        if np.count_nonzero(matched >= 0) < 3 or (iteration > 0 and np.array_equal(matched, before)):
            break
        place_of = matched
    all_of, sheet = search.matched(at, ratio, reach, np.inf), search.sheet
    rows, all_rows = np.flatnonzero(place_of >= 0), np.flatnonzero(all_of >= 0)
    return Grown(
        pattern=pattern,
        sheet=sheet,
        rows=rows,
        places=place_of[rows],
        all_rows=all_rows,
        all_places=all_of[all_rows],
        xy_mm=at * sheet.unit_mm + sheet.centre_mm,
        log_ratio=ratio,
        level=float(level - np.log(seed.similarity.scale)),
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """The detections and the places of one plate, in units of the field's radius.

    Detections `w` (N, 2), with `log_radius`, `noise` and whether `usable` (N,); `phi` (3, N, 21): their `features`.
    Places `target` (P, 2) with `log_half` (P,), log radii in mm.
    """

    sheet: Sheet
    w: np.ndarray
    phi: np.ndarray
    log_radius: np.ndarray
    noise: np.ndarray
    usable: np.ndarray
    target: np.ndarray
    log_half: np.ndarray
    pitch: float

    @staticmethod
    def of(seed: Seed, detections: Detections, usable: np.ndarray) -> "_Search":
        sheet, pattern = Sheet.of(seed.similarity, Field.of(detections.uv_px)), seed.pattern
        w, unit = sheet.w(detections.uv_px), sheet.unit_mm
        noise, target = sheet.noise(detections.covariance_px2) + REMAINDER**2, (pattern.xy_mm - sheet.centre_mm) / unit
        log_radius, pitch = np.log(detections.radius_px), pattern.pitch_mm / unit
        return _Search(sheet, w, features(w), log_radius, noise, usable, target, pattern.log_half, pitch)

    def level(self, ratio: np.ndarray, place_of: np.ndarray) -> float:
        """Return the median log ratio of the beads' radii to those of their places (N,), or -1."""
        seen = place_of >= 0
        return median(ratio[seen] - self.log_half[place_of[seen]])

    def mapped(self, place_of: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit the map to beads at places (N,), or -1; return each detection's place (N, 2), log radius and reach (N,).

        The reach is GATE standard deviations. Coefficients have unit priors.
        """
        seen = place_of >= 0
        weighted = self.phi[0][seen].T / noise[seen]
        lower = cholesky(weighted @ self.phi[0][seen] + np.eye(len(weighted)))
        white = solve_lower(lower, weighted @ (self.target[place_of[seen]] - self.w[seen]))
        change, by_x, by_y = self.phi @ solve_lower_transposed(lower, white)
        area = np.abs((1.0 + by_x[:, 0]) * (1.0 + by_y[:, 1]) - by_x[:, 1] * by_y[:, 0])
        variance = (solve_lower(lower, self.phi[0].T) ** 2).sum(axis=0)
        ratio = self.log_radius + 0.5 * np.log(np.maximum(area, 1e-6))
        return self.w + change, ratio, GATE * np.sqrt(variance + self.noise)

    def matched(self, at: np.ndarray, ratio: np.ndarray, reach: np.ndarray, sized: float) -> np.ndarray:
        """Return the place (N,) of each detection, or -1: mutual nearest neighbours within `reach`.

        Log radii agree to within `sized`.
        """
        off2 = exact_squares(at, self.target)
        possible = self.usable[:, None] & (off2 < (reach**2)[:, None])
        possible &= np.abs(ratio[:, None] - self.log_half) < sized
        off2[~possible] = np.inf
        rows, best, owner = np.arange(len(at)), off2.argmin(axis=1), off2.argmin(axis=0)
        return np.where(possible[rows, best] & (owner[best] == rows), best, -1)
