"""Grow a seed of three beads to all beads of a plate: predict, match, fit again, outward from the seed."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.detection.labelling.map_prior import features
from sightline.detection.labelling.patterns import Pattern
from sightline.detection.labelling.seeds import Seed, Similarity
from sightline.detection.results import Detections
from sightline.kernels import exact_unchecked

REMAINDER = 0.003  # s.d. beyond degree 5, share of the radius: 0.3 mm of 107 (physics.md: 0.11-0.13 mm rms) [ours]
GATE = 3.5  # standard deviations [ours]
CERTAIN = 0.3  # of the pitch: where the gate is wider, beads are not matched yet [ours]
LOG_RADIUS = 0.15  # largest error of a bead's log radius: below half the step from 3 to 5 mm [ours]
AGREES = 0.15  # of the pitch: gate of the first matches by the seed's similarity [ours]
LOOSE = 0.1  # of the pitch: s.d. added in the first fit of the map [ours]
MAX_ROUNDS = 15


@exact_unchecked
def _fit(phi, noise, place_of, target, w, upper, beta):  # noqa: PLR0912, PLR0917 - a kernel
    """Fill `beta` (21, 2), the coefficients, and `upper`, the Cholesky factor of their information; unit priors."""
    size = len(beta)
    for i in range(size):
        beta[i, 0] = beta[i, 1] = 0.0
        for j in range(i, size):
            upper[i, j] = 1.0 if i == j else 0.0
    for n in range(len(w)):
        p = place_of[n]
        if p < 0:
            continue
        x, y = target[p, 0] - w[n, 0], target[p, 1] - w[n, 1]
        for i in range(size):
            f = phi[n, i] / noise[n]
            beta[i, 0] += f * x
            beta[i, 1] += f * y
            for j in range(i, size):
                upper[i, j] += f * phi[n, j]
    for i in range(size):
        root = np.sqrt(upper[i, i])
        beta[i, 0] /= root
        beta[i, 1] /= root
        for j in range(i, size):
            upper[i, j] /= root
        for j in range(i + 1, size):
            f = upper[i, j]
            beta[j, 0] -= f * beta[i, 0]
            beta[j, 1] -= f * beta[i, 1]
            for k in range(j, size):
                upper[j, k] -= f * upper[i, k]
    for i in range(size - 1, -1, -1):
        for c in range(2):
            for j in range(i + 1, size):
                beta[i, c] -= upper[i, j] * beta[j, c]
            beta[i, c] /= upper[i, i]


@exact_unchecked
def _transpose(phi, terms):
    """Fill `terms` (3, 21, N) from `features` (3, N, 21)."""
    for d in range(3):
        for n in range(phi.shape[1]):
            for k in range(phi.shape[2]):
                terms[d, k, n] = phi[d, n, k]


@exact_unchecked
def _predict(terms, noise, w, log_r, upper, beta, at, ratio, reach):  # noqa: PLR0917 - a kernel
    """Fill each detection's mapped place `at`, log radius `ratio`, and `reach`: GATE standard deviations.

    `terms` (3, 21, N): `features`, transposed so that the inner loops are vectorised over the detections.
    """
    size, count = len(beta), len(w)
    added, variance = np.zeros((2 * len(terms), count)), np.zeros(count)  # `added`: x, y and their derivatives
    z, share = np.empty((size, count)), np.empty(count)
    for k in range(size):
        for n in range(count):
            z[k, n] = terms[0, k, n]
    for k in range(size):
        for i in range(len(added)):
            total, term, b = added[i], terms[i // 2, k], beta[k, i % 2]
            for n in range(count):
                total[n] += term[n] * b
        own, pivot = z[k], upper[k, k]
        for n in range(count):
            share[n] = own[n] / pivot
            variance[n] += share[n] * share[n]
        for j in range(k + 1, size):
            other, u = z[j], upper[k, j]
            for n in range(count):
                other[n] -= share[n] * u
    for n in range(count):
        x, x_by_x, x_by_y = added[0, n], added[2, n], added[4, n]
        y, y_by_x, y_by_y = added[1, n], added[3, n], added[5, n]
        area = abs((1.0 + x_by_x) * (1.0 + y_by_y) - y_by_x * x_by_y)
        at[n, 0], at[n, 1] = w[n, 0] + x, w[n, 1] + y
        ratio[n] = log_r[n] + 0.5 * np.log(max(area, 1e-6))
        reach[n] = GATE * np.sqrt(variance[n] + noise[n])


@exact_unchecked
def _match(at, reach, target, ratio, log_half, sized, usable, place_of):  # noqa: PLR0917 - a kernel
    """Fill `place_of` (N,) with mutual nearest neighbours of detections and places, or -1; return (changed, matched).

    Only within `reach`, and where the log radius agrees to within `sized`. Returns the number of changed entries and
    the number of matched detections.
    """
    owner, near, off2 = np.empty(len(target), np.int64), np.empty(len(target)), np.empty(len(target))
    for p in range(len(target)):
        owner[p], near[p] = -1, np.inf
    best = np.empty(len(at), np.int64)
    for n in range(len(at)):
        best[n] = -1
        nearest = limit = reach[n] ** 2 if usable[n] else 0.0
        for p in range(len(target)):  # vectorised; few are near
            off2[p] = (at[n, 0] - target[p, 0]) ** 2 + (at[n, 1] - target[p, 1]) ** 2
        for p in range(len(target)):
            if off2[p] < limit and abs(ratio[n] - log_half[p]) < sized:
                if off2[p] < nearest:
                    nearest, best[n] = off2[p], p
                if off2[p] < near[p]:
                    near[p], owner[p] = off2[p], n
    changed = count = 0
    for n in range(len(at)):
        p = best[n] if best[n] >= 0 and owner[best[n]] == n else -1
        changed += p != place_of[n]
        count += p >= 0
        place_of[n] = p
    return changed, count


@exact_unchecked
def _level(ratio, log_half, place_of):
    """Return the median log ratio of the beads' radii to those of their places."""
    off, count = np.empty(len(ratio)), 0
    for n in range(len(ratio)):
        if place_of[n] >= 0:
            one, k = ratio[n] - log_half[place_of[n]], count
            while k > 0 and off[k - 1] > one:
                off[k] = off[k - 1]
                k -= 1
            off[k] = one
            count += 1
    return (off[(count - 1) // 2] + off[count // 2]) / 2


@exact_unchecked
def _grow(w, log_r, noise, target, log_half, pitch, seed, usable):  # noqa: PLR0917 - a kernel
    """Iterate `grow` in units of the field's radius. `seed` (N,): the place of each detection, or -1."""
    phi = features(w)
    terms = np.empty((3, phi.shape[2], len(w)))
    _transpose(phi, terms)
    upper, beta = np.empty((phi.shape[2], phi.shape[2])), np.empty((phi.shape[2], 2))
    at, ratio, reach = w.copy(), log_r.copy(), np.empty(len(w))
    loose = noise.copy()
    place_of, matched, all_of = seed.copy(), seed.copy(), seed.copy()
    level = _level(ratio, log_half, seed)
    for n in range(len(w)):
        ratio[n] -= level
        reach[n] = AGREES * pitch
        loose[n] += (LOOSE * pitch) ** 2
    _match(at, reach, target, ratio, log_half, LOG_RADIUS, usable, place_of)
    for n in range(len(w)):  # seed assignments take precedence
        for m in range(len(w)):
            if seed[n] >= 0 and place_of[m] == seed[n]:
                place_of[m] = -1
    for n in range(len(w)):
        if seed[n] >= 0:
            place_of[n] = seed[n]
    for iteration in range(MAX_ROUNDS):
        _fit(phi[0], noise if iteration else loose, place_of, target, w, upper, beta)
        _predict(terms, noise, w, log_r, upper, beta, at, ratio, reach)
        level = _level(ratio, log_half, place_of)
        for n in range(len(w)):
            ratio[n] -= level
            matched[n] = place_of[n]
            if reach[n] > CERTAIN * pitch:
                reach[n] = 0.0
        changed, count = _match(at, reach, target, ratio, log_half, LOG_RADIUS, usable, matched)
        if count < 3 or (changed == 0 and iteration > 0):
            break
        for n in range(len(w)):
            place_of[n] = matched[n]
    _match(at, reach, target, ratio, log_half, np.inf, usable, all_of)
    return place_of, all_of, at, ratio, level


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
    pattern = seed.pattern
    sheet = Sheet.of(seed.similarity, Field.of(detections.uv_px))
    place_of = np.full(len(detections), -1)
    place_of[seed.rows] = seed.places
    place_of, all_of, at, log_ratio, level = _grow(
        sheet.w(detections.uv_px),
        np.log(detections.radius_px),
        sheet.noise(detections.covariance_px2) + REMAINDER**2,
        (pattern.xy_mm - sheet.centre_mm) / sheet.unit_mm,
        pattern.log_half,
        pattern.pitch_mm / sheet.unit_mm,
        place_of,
        usable,
    )
    rows, all_rows = np.flatnonzero(place_of >= 0), np.flatnonzero(all_of >= 0)
    return Grown(
        pattern=pattern,
        sheet=sheet,
        rows=rows,
        places=place_of[rows],
        all_rows=all_rows,
        all_places=all_of[all_rows],
        xy_mm=at * sheet.unit_mm + sheet.centre_mm,
        log_ratio=log_ratio,
        level=float(level - np.log(seed.similarity.scale)),
    )
