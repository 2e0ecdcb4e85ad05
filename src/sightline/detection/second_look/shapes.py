"""Shapes of a plate's shadows (radius, blur, ellipticity), as the other beads of the plate predict them."""

import numpy as np

from sightline.common.fitting import MAD_TO_SD
from sightline.detection.labelling.patterns import Pattern

SHAPE = ["radius_px", "blur_px", "axial", "diagonal"]  # fields of a bead
_MEAN_ALONE = np.array([False, True, False, False])
# Over a plate, log size and ellipticity follow a quadratic polynomial of the place to 0.002-0.007 [twin]: perspective,
# distortion and oblique rays. The blur is the same everywhere.
_TERMS = 6
_ENOUGH = 15  # beads for a quadratic polynomial; fewer give a mean [ours]
_FLOOR = np.array([0.003, 0.02, 0.003, 0.003])  # least s.d. of log size, log blur and ellipticities [twin]
_RIDGE = 0.01  # of the polynomial's coefficients, so that they are determined [ours]
_HUBER = 1.5  # s.d. beyond which a bead counts less [ours]
_ROUNDS = 8  # of reweighting [ours]


def expected_shapes(pattern: Pattern, seen: np.ndarray, beads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shapes (P, 4), fields SHAPE, of all beads of a plate, and their s.d. (P, 4).

    The s.d. of radius and blur are shares of their values. `beads` (M,): fits of the plate's beads `seen` (M,), M >= 3.
    A polynomial of the place is fitted robustly to each field.
    """
    x, y = (2 * (pattern.xy_mm - pattern.xy_mm.mean(axis=0)) / np.ptp(pattern.xy_mm)).T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[None].repeat(len(SHAPE), axis=0)
    simple = _MEAN_ALONE | (len(seen) < _ENOUGH)
    design[simple, :, 1:] = 0.0
    values = np.stack([beads[name] for name in SHAPE])
    values[0] /= pattern.diameter_mm[seen]
    values[:2] = np.log(values[:2])
    freedom = len(seen) - np.where(simple, 1, _TERMS)
    known, ridge = design[:, seen], np.diag([0.0, *[_RIDGE] * (_TERMS - 1)])
    normal, coefficients, spread = ridge, values, np.full(len(SHAPE), np.inf)
    rest = np.zeros(values.shape)
    for _ in range(_ROUNDS):
        weight = 1.0 / np.maximum(1.0, rest / (_HUBER * spread[:, None]))
        weighted = np.swapaxes(known * weight[:, :, None], 1, 2)
        normal = weighted @ known + ridge
        coefficients = np.linalg.solve(normal, weighted @ values[:, :, None])
        rest = np.abs(values - (known @ coefficients)[:, :, 0])
        spread = np.maximum(MAD_TO_SD * np.median(rest, axis=1) * np.sqrt(len(seen) / freedom), _FLOOR)
    mean = (design @ coefficients)[:, :, 0].T
    leverage = (design * np.swapaxes(np.linalg.solve(normal, np.swapaxes(design, 1, 2)), 1, 2)).sum(axis=2)
    mean[:, :2] = np.exp(mean[:, :2])
    mean[:, 0] *= pattern.diameter_mm
    return mean, (spread[:, None] * np.sqrt(1.0 + leverage)).T
