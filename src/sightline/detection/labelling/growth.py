"""From three beads to all beads of a plate: predict, take what fits, fit again, outward from the seed."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, Similarity
from sightline.detection.results import Detections

DEGREE = 5
# What a map adds to a similarity, per degree, as a share of half the image: position, tilt and scale, perspective of
# a 20° tilt, 9 % pincushion with a 4° S, and what both leave at higher degrees (physics.md, Distortion) [ours].
PRIOR = np.array([0.3, 0.15, 0.06, 0.10, 0.03, 0.03])
REMAINDER = 0.003  # smooth rest beyond degree 5, same share: 0.3 mm of 107 (physics.md: 0.11-0.13 mm rms) [ours]
GATE = 3.5  # standard deviations [ours]
CERTAIN = 0.3  # of the pitch: where the gate is wider a bead is not yet taken [ours]
LOG_RADIUS = 0.15  # a bead's log radius against its plate's: below half the step from 3 to 5 mm [ours]
MOST_ROUNDS = 15

_POWERS = np.array([(d - k, k) for d in range(DEGREE + 1) for k in range(d + 1)])
_SD = PRIOR[_POWERS.sum(axis=1)]


@njit(cache=True)
def features(w):
    """(3, N, 21): monomials to degree 5 of (N, 2), times their prior standard deviations, and their derivatives."""
    out = np.zeros((3, len(w), len(_POWERS)))
    x, y = np.ones(DEGREE + 1), np.ones(DEGREE + 1)
    for n in range(len(w)):
        for d in range(DEGREE):
            x[d + 1], y[d + 1] = x[d] * w[n, 0], y[d] * w[n, 1]
        for k in range(len(_POWERS)):
            i, j = _POWERS[k]
            out[0, n, k] = x[i] * y[j] * _SD[k]
            out[1, n, k] = i * x[max(i - 1, 0)] * y[j] * _SD[k]
            out[2, n, k] = j * x[i] * y[max(j - 1, 0)] * _SD[k]
    return out


@njit(cache=True)
def _fit(phi, noise, rows, residual):
    """Coefficients (21, 2) and the inverse of their Cholesky factor, for unit priors."""
    size = phi.shape[1]
    information, right = np.eye(size), np.zeros((size, 2))
    for m in range(len(rows)):
        f, weight = phi[rows[m]], 1.0 / noise[rows[m]]
        for i in range(size):
            information[i] += weight * f[i] * f
            right[i] += weight * f[i] * residual[m]
    root = np.linalg.inv(np.linalg.cholesky(information))
    return root.T @ (root @ right), root


@njit(cache=True)
def _mutual(at, reach, target, ratio, log_half, sized, usable):  # noqa: PLR0917 - a kernel
    """The place nearest to each detection, and the detections that are also the nearest of their place.

    Within `reach` only, and where the log radius is right within `sized`.
    """
    best, owner = np.full(len(at), -1), np.full(len(target), -1)
    near = np.full(len(target), np.inf)
    for n in range(len(at)):
        nearest = reach[n] ** 2
        for p in range(len(target)):
            d = (at[n, 0] - target[p, 0]) ** 2 + (at[n, 1] - target[p, 1]) ** 2
            if usable[n] and d < reach[n] ** 2 and abs(ratio[n] - log_half[p]) < sized:
                if d < nearest:
                    nearest, best[n] = d, p
                if d < near[p]:
                    near[p], owner[p] = d, n
    mutual = [n for n in range(len(at)) if best[n] >= 0 and owner[best[n]] == n]
    return best, np.array(mutual, dtype=np.int64)


@njit(cache=True)
def _grow(w, log_r, noise, target, log_half, pitch, rows, places, usable):  # noqa: PLR0917 - a kernel
    """The rounds of `grow`, in units of half the image."""
    phi = features(w)
    at, ratio, reach = w.copy(), log_r.copy(), noise.copy()
    for _ in range(MOST_ROUNDS):
        beta, root = _fit(phi[0], noise, rows, target[places] - w[rows])
        at = w + phi[0] @ beta
        by_x, by_y = phi[1] @ beta, phi[2] @ beta
        area = (1.0 + by_x[:, 0]) * (1.0 + by_y[:, 1]) - by_x[:, 1] * by_y[:, 0]
        ratio = log_r + 0.5 * np.log(np.maximum(np.abs(area), 1e-6))
        level = np.median(ratio[rows] - log_half[places])
        reach = GATE * np.sqrt((((phi[0] @ root.T) ** 2).sum(axis=1)) + noise)
        reach[reach > CERTAIN * pitch] = 0.0
        best, taken = _mutual(at, reach, target, ratio - level, log_half, LOG_RADIUS, usable)
        if len(taken) < 3 or (len(taken) == len(rows) and (taken == rows).all() and (best[taken] == places).all()):
            break
        rows, places = taken, best[taken]
    level = np.median(ratio[rows] - log_half[places])
    ratio -= level
    best, taken = _mutual(at, reach, target, ratio, log_half, np.inf, usable)
    return rows, places, at, ratio, level, taken, best[taken]


@dataclass(frozen=True, eq=False)
class Sheet:
    """Image coordinates laid out on a plate by a similarity: w = mm / `unit_mm` from the image's centre."""

    similarity: Similarity
    centre_mm: np.ndarray
    unit_mm: float

    @staticmethod
    def of(similarity: Similarity, image_shape: tuple[int, int]) -> "Sheet":
        """The unit is half the longer side of the image."""
        height, width = image_shape
        centre = similarity.to_plate(np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
        return Sheet(similarity, centre, max(height, width) / 2 / similarity.scale)

    def w(self, uv_px: np.ndarray) -> np.ndarray:
        """(N, 2), within about ±1."""
        return (self.similarity.to_plate(uv_px) - self.centre_mm) / self.unit_mm

    def noise(self, covariance_px2: np.ndarray) -> np.ndarray:
        """(N,) variance per axis of the detections, in units²."""
        return np.trace(covariance_px2, axis1=1, axis2=2) / 2 / (self.similarity.scale * self.unit_mm) ** 2


@dataclass(frozen=True, eq=False)
class Grown:
    """One plate's beads: detections `rows` are its fiducials `places`; whatever their size: `all_rows`, `all_places`.

    For all detections: `xy_mm` (N, 2) where the plate's map puts them; `log_ratio` (N,), the log of the radius in mm
    there, in the plate's own measure (an ordinary bead's is the log of its radius). `level`:
    by how much the detected radii of this plate's beads exceed the true ones, log.
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
    """The beads of the seed's plate, as far as one smooth map reaches them."""
    pattern = seed.pattern
    sheet = Sheet.of(seed.similarity, detections.image_shape)
    rows, places, at, log_ratio, level, all_rows, all_places = _grow(
        sheet.w(detections.uv_px),
        np.log(detections.radius_px),
        sheet.noise(detections.covariance_px2) + REMAINDER**2,
        (pattern.xy_mm - sheet.centre_mm) / sheet.unit_mm,
        np.log(pattern.diameter_mm / 2),
        pattern.pitch_mm / sheet.unit_mm,
        seed.rows,
        seed.places,
        usable,
    )
    xy_mm = at * sheet.unit_mm + sheet.centre_mm
    level -= np.log(seed.similarity.scale)
    return Grown(pattern, sheet, rows, places, all_rows, all_places, xy_mm, log_ratio, float(level))
