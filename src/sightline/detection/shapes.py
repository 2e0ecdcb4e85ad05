"""Shapes of a plate's shadows (radius, blur, ellipticity), as the other beads of the plate predict them."""

import numpy as np

from sightline.detection.columns import AXIAL, BLUR, DIAGONAL, RADIUS
from sightline.detection.labelling.patterns import Pattern
from sightline.fitting.robust import MAD_TO_SD, median

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
    for k, value in enumerate(values.T):
        terms = 1 if SHAPE[k] == BLUR or len(seen) < _ENOUGH else _TERMS
        mean[:, k], sd[:, k] = _predicted(places[:, :terms], seen, value, float(_FLOOR[k]))
    mean[:, :2] = np.exp(mean[:, :2])
    mean[:, 0] *= pattern.diameter_mm
    return mean, sd


def _predicted(places: np.ndarray, seen: np.ndarray, value: np.ndarray, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a robust linear fit of `value` (M,) at the places (P, K) of rows `seen`, at all places, and its s.d."""
    design, terms = places[seen], places.shape[1]
    ridge = _RIDGE * np.eye(terms)
    ridge[0, 0] = 0.0
    weight, normal, coefficients, sd = np.ones(len(seen)), ridge, np.zeros(terms), floor
    for _ in range(_ROUNDS):
        normal = design.T @ (weight[:, None] * design) + ridge
        coefficients = np.linalg.solve(normal, design.T @ (weight * value))
        rest = abs(value - design @ coefficients)
        sd = max(MAD_TO_SD * median(rest) * np.sqrt(len(seen) / (len(seen) - terms)), floor)
        weight = 1.0 / np.maximum(1.0, rest / (_HUBER * sd))
    leverage = np.einsum("pi,ij,pj->p", places, np.linalg.inv(normal), places)
    return places @ coefficients, sd * np.sqrt(1.0 + leverage)
