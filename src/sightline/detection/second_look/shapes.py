"""Shapes of a plate's shadows (radius, blur, ellipticity), as the other beads of the plate predict them."""

import numpy as np

from sightline.detection.beads.columns import AXIAL, BLUR, DIAGONAL, RADIUS
from sightline.detection.labelling.joint_kernels import median_of
from sightline.detection.labelling.patterns import Pattern
from sightline.fitting.dense import factor, fast
from sightline.fitting.robust import MAD_TO_SD

SHAPE = np.array([RADIUS, BLUR, AXIAL, DIAGONAL])
# Over a plate, log size and ellipticity follow a quadratic polynomial of the place to 0.002-0.007 [twin]: perspective,
# distortion and oblique rays. The blur is the same everywhere.
_TERMS = 6
_ENOUGH = 15  # beads for a quadratic polynomial; fewer give a mean [ours]
_FLOOR = np.array([0.003, 0.02, 0.003, 0.003])  # least s.d. of log size, log blur and ellipticities [twin]
_RIDGE = 0.01  # of the polynomial's coefficients, so that they are determined [ours]
_HUBER = 1.5  # s.d. beyond which a bead counts less [ours]
_ROUNDS = 8  # of reweighting [ours]


def expected_shapes(pattern: Pattern, seen: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return columns SHAPE (P, 4) of all beads of a plate, and their s.d. (radius and blur: share of the value).

    `rows` (M, COUNT): fits of its beads `seen` (M,), M >= 3.
    """
    x, y = (2 * (pattern.xy_mm - pattern.xy_mm.mean(axis=0)) / np.ptp(pattern.xy_mm)).T
    places = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    values = rows[:, SHAPE]
    values[:, 0] /= pattern.diameter_mm[seen]
    values[:, :2] = np.log(values[:, :2])
    mean, sd = np.empty((len(x), len(SHAPE))), np.empty((len(x), len(SHAPE)))
    for k, value in enumerate(np.ascontiguousarray(values.T)):
        terms = 1 if SHAPE[k] == BLUR or len(seen) < _ENOUGH else _TERMS
        mean[:, k], sd[:, k] = _predicted(np.ascontiguousarray(places[:, :terms]), seen, value, float(_FLOOR[k]))
    mean[:, :2] = np.exp(mean[:, :2])
    mean[:, 0] *= pattern.diameter_mm
    return mean, sd


def _predicted(places: np.ndarray, seen: np.ndarray, value: np.ndarray, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a robust linear fit of `value` (M,) at the places (P, K) of rows `seen`, at all places, and its s.d."""
    mean, sd = np.empty(len(places)), np.empty(len(places))
    if not _fill_predicted(places, seen, value, floor, mean, sd):
        raise np.linalg.LinAlgError("the beads do not determine the shapes of the others")
    return mean, sd


@fast
def _fill_predicted(places, seen, value, floor, mean, sd):  # noqa: PLR0912, PLR0917 - a kernel
    """Fill `mean` and `sd` (P,) of `_predicted`; return whether the normal matrix is positive definite."""
    count, terms, spread = len(seen), places.shape[1], floor
    lower, coefficients = np.empty((terms, terms)), np.empty(terms)
    weight, rest, ordered = np.ones(count), np.empty(count), np.empty(count)
    for _ in range(_ROUNDS):
        for i in range(terms):
            coefficients[i] = 0.0
            for j in range(i + 1):
                lower[i, j] = _RIDGE if i == j and i > 0 else 0.0
        for n in range(count):
            row = places[seen[n]]
            for i in range(terms):
                part = weight[n] * row[i]
                coefficients[i] += part * value[n]
                for j in range(i + 1):
                    lower[i, j] += part * row[j]
        if not factor(terms, lower):
            return False
        for i in range(terms):
            for j in range(i):
                coefficients[i] -= lower[i, j] * coefficients[j]
            coefficients[i] /= lower[i, i]
        for i in range(terms - 1, -1, -1):
            coefficients[i] /= lower[i, i]
            for j in range(i):
                coefficients[j] -= lower[i, j] * coefficients[i]
        for n in range(count):
            fitted = 0.0
            for i in range(terms):
                fitted += places[seen[n], i] * coefficients[i]
            rest[n] = ordered[n] = abs(value[n] - fitted)
        spread = max(MAD_TO_SD * median_of(ordered, count) * np.sqrt(count / (count - terms)), floor)
        for n in range(count):
            weight[n] = 1.0 / max(1.0, rest[n] / (_HUBER * spread))
    half = np.empty(terms)
    for p in range(len(places)):
        mean[p], leverage = 0.0, 0.0
        for i in range(terms):
            mean[p] += places[p, i] * coefficients[i]
            half[i] = places[p, i]
            for j in range(i):
                half[i] -= lower[i, j] * half[j]
            half[i] /= lower[i, i]
            leverage += half[i] * half[i]
        sd[p] = spread * np.sqrt(1.0 + leverage)
    return True
