"""Errors of points and directions, and the lengths that they stay below with a given probability."""

import numpy as np
from scipy.optimize import elementwise
from scipy.special import erf, ndtri
from scipy.stats import chi2

# Nodes over one octant of directions: the probability is right to 1e-6 (tests/geometry/test_covariance.py).
_COSINES, _COSINE_WEIGHTS = np.polynomial.legendre.leggauss(24)
_HEIGHTS = (_COSINES + 1) / 2
_TURNS = (np.arange(12) + 0.5) * np.pi / 24


def ellipsoid_factor(probability: float, dimension: int) -> float:
    """How many standard deviations the ellipsoid reaches that holds a Gaussian of `dimension` with `probability`."""
    return float(np.sqrt(chi2.ppf(probability, dimension)))


def length_quantile(covariance: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """(...): the length that a Gaussian error of covariance (..., d, d), d = 1 to 3, stays below with `probability`.

    The length's distribution is a generalised chi: given its direction u, a Gaussian's length is chi with 3
    degrees of freedom times |root(covariance) u|, and the directions are uniform; they are integrated numerically.
    Raises ValueError for a covariance with a negative variance.
    """
    covariance = np.asarray(covariance, dtype=np.float64)
    values = np.linalg.eigvalsh(covariance)
    if (values[..., 0] < -1e-9 * np.abs(values[..., -1])).any():
        raise ValueError("a covariance has a negative variance")
    variances = np.zeros((*values.shape[:-1], 3))
    variances[..., : values.shape[-1]] = np.sort(np.clip(values, 0.0, None))[..., ::-1]
    largest = np.sqrt(variances[..., 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        shape = np.nan_to_num(variances[..., 1:] / variances[..., :1])
    low, high = ndtri((1 + probability) / 2) * 0.999, ellipsoid_factor(probability, 3) * 1.001
    root = elementwise.find_root(
        lambda radius, b, c: _within(radius, b, c) - probability,
        (np.full(largest.shape, low), np.full(largest.shape, high)),
        args=(shape[..., 0], shape[..., 1]),
    )
    return largest * root.x


def line_direction(start_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    """(2, 6): how the direction of the line from `start_mm` to `end_mm` (3,) turns, in rad about two axes across it, as
    the two points move."""
    along = end_mm - start_mm
    length = np.linalg.norm(along)
    across = np.linalg.svd(along[None] / length)[2][1:]
    return np.hstack([-across, across]) / length


def _within(radius: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """P(length < radius) of a Gaussian with the variances 1, b, c."""
    ring = 1 - _HEIGHTS[:, None] ** 2
    stretch2 = _HEIGHTS[:, None] ** 2 + ring * (
        b[..., None, None] * np.cos(_TURNS) ** 2 + c[..., None, None] * np.sin(_TURNS) ** 2
    )
    reach = radius[..., None, None] / np.sqrt(stretch2)
    chi3 = erf(reach / np.sqrt(2)) - np.sqrt(2 / np.pi) * reach * np.exp(-(reach**2) / 2)
    return (chi3.mean(axis=-1) * _COSINE_WEIGHTS / 2).sum(axis=-1)
