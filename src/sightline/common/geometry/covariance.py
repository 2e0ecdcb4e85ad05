"""Covariances of points and directions, and quantiles of error lengths."""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.special import erf, gammaincinv, ndtri

TWO_SIDED_95 = 1.959964  # s.d.; ± this holds 95 % of a normal distribution
TWO_SIDED_999 = 3.29  # the same for 99.9 %: exceeded once in a thousand valid cases
# Nodes over one octant of directions: the probability is accurate to 1e-6 (tests/geometry/test_covariance.py).
_COSINES, _COSINE_WEIGHTS = np.polynomial.legendre.leggauss(24)
_HEIGHTS = (_COSINES + 1) / 2
_ITERATIONS, _PRECISION = 60, 1e-10  # bisection alone would need 35
_STEP_MM = 1e-3  # of a central difference: the error, from the third derivative, is below 1e-9 here [calc]
_AZIMUTHS = (np.arange(12) + 0.5) * np.pi / 24
_WEIGHTS = np.repeat(_COSINE_WEIGHTS, len(_AZIMUTHS)) / (2 * len(_AZIMUTHS))
# (3, N): squared components of the unit vectors at the nodes.
_SQUARES = np.stack(
    [
        np.repeat(_HEIGHTS**2, len(_AZIMUTHS)),
        np.outer(1 - _HEIGHTS**2, np.cos(_AZIMUTHS) ** 2).ravel(),
        np.outer(1 - _HEIGHTS**2, np.sin(_AZIMUTHS) ** 2).ravel(),
    ]
)


@cache  # only the target of a drill through walls needs it
def _sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (N, 4) and weights (N,) that integrate a function of opposite directions alike."""
    angle = (np.arange(32) + 0.5) * np.pi / 32
    height, first, second = (grid.ravel() for grid in np.meshgrid(_HEIGHTS, angle, 2 * angle, indexing="ij"))
    a, b = np.sqrt(height), np.sqrt(1 - height)
    nodes = np.stack([a * np.cos(first), a * np.sin(first), b * np.cos(second), b * np.sin(second)], axis=1)
    return nodes, np.repeat(_COSINE_WEIGHTS / 2, len(angle) ** 2) / len(angle) ** 2


def ellipsoid_factor(probability: float, dimension: int) -> float:
    """Return the semi-axes, in s.d., of the ellipsoid that contains a Gaussian of `dimension` with `probability`."""
    # The chi-square quantile without scipy.stats, whose import takes half a second.
    return float(np.sqrt(2.0 * gammaincinv(dimension / 2.0, probability)))


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """Return the matrix (2N, 2N) with blocks (N, 2, 2) on its diagonal."""
    n = len(blocks)
    matrix = np.zeros((n, 2, n, 2))
    matrix[range(n), :, range(n), :] = blocks
    return matrix.reshape(2 * n, 2 * n)


def joined(own: Sequence[np.ndarray], between: Callable[[int, int], np.ndarray]) -> np.ndarray:
    """Return the covariance of several vectors: `own` (n_i, n_i) of each, `between(i, j)` (n_i, n_j) of two, i < j."""
    ends = np.cumsum([0, *(len(block) for block in own)])
    at = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    covariance = np.zeros((ends[-1], ends[-1]))
    for i, block in enumerate(own):
        covariance[at[i], at[i]] = block
        for j in range(i + 1, len(own)):
            covariance[at[i], at[j]] = between(i, j)
            covariance[at[j], at[i]] = covariance[at[i], at[j]].T
    return covariance


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """Return a factor F (n, n), F @ F.T = covariance, of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.clip(values, 0.0, None))


def length_quantile(covariance: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Return the quantile (...) of the length of a Gaussian error with covariance (..., d, d), d = 1 to 3.

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
    none = variances[..., :1] == 0.0
    shape = np.where(none, 0.0, variances[..., 1:] / np.where(none, 1.0, variances[..., :1]))
    return largest * _radius(probability, shape[..., 0], shape[..., 1])


def both_within(covariance: np.ndarray, radius: float) -> float:
    """Return the probability that two plane errors, jointly Gaussian with covariance (4, 4), are both shorter than a
    radius.

    In each direction of the four-dimensional space the Gaussian's length is chi with 4 degrees of freedom; the
    directions are integrated numerically, to about 1e-4 (tests/geometry/test_covariance.py). Raises ValueError for a
    covariance with a negative variance.
    """
    values, vectors = np.linalg.eigh(covariance)
    if values[0] < -1e-9 * abs(values[-1]):
        raise ValueError("a covariance has a negative variance")
    first, second = (vectors * np.sqrt(np.clip(values, 0.0, None))).reshape(2, 2, 4)
    nodes, weights = _sphere()
    longest = np.maximum(*(((nodes @ half.T) ** 2).sum(axis=1) for half in (first, second)))
    half = radius**2 / np.maximum(longest, 1e-300) / 2
    return float(((1 - np.exp(-half) * (1 + half)) * weights).sum())


def line_direction(start_mm: np.ndarray, end_mm: np.ndarray) -> np.ndarray:
    """Return the derivative (2, 6), rad/mm, of a line's direction by its points `start_mm` and `end_mm` (3,).

    The direction's rotations are about two axes perpendicular to the line.
    """
    along = end_mm - start_mm
    length = np.linalg.norm(along)
    across = np.linalg.svd(along[None] / length)[2][1:]
    return np.hstack([-across, across]) / length


def response(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return value (m,) and derivative (m, n), at the point `at` (n,), of a function that maps (K, n) to (K, m)."""
    steps = _STEP_MM * np.eye(len(at))
    values = function(np.concatenate([at[None], at + steps, at - steps]))
    up, down = values[1 : len(at) + 1], values[len(at) + 1 :]
    return values[0], (up - down).T / (2 * _STEP_MM)


def _radius(probability: float, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the quantile of the length of a Gaussian with variances 1, b and c, by bracketed Newton iterations."""
    scale = 1 / np.sqrt(2 * (np.stack([np.ones_like(b), b, c], axis=-1) @ _SQUARES))
    low, high = _bracket(probability)
    below, above = np.full(b.shape, low), np.full(b.shape, high)
    # Start with the quantile of the scaled chi-square that has the same mean and variance, which is near.
    mean, half = 1 + b + c, 1 + b**2 + c**2
    radius = np.clip(np.sqrt(2 * half / mean * gammaincinv(mean**2 / half / 2, probability)), below, above)
    for _ in range(_ITERATIONS):
        within, density = _within(radius, scale)
        below, above = np.where(within < probability, radius, below), np.where(within < probability, above, radius)
        step = radius - (within - probability) / density
        following = np.where((step > below) & (step < above), step, (below + above) / 2)
        if np.all(np.abs(following - radius) < _PRECISION):
            return following
        radius = following
    return radius


@cache
def _bracket(probability: float) -> tuple[float, float]:
    """Return lengths between which the quantile lies: that of one variance, and that of three equal ones."""
    return float(ndtri((1 + probability) / 2)) * 0.999, ellipsoid_factor(probability, 3) * 1.001


def _within(radius: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return P(length < radius) of a Gaussian, and its derivative by the radius; `scale` (..., N): 1 / sqrt(2) of its
    s.d. in the direction of each node."""
    reach = radius[..., None] * scale
    square = reach**2
    tail = 2 / np.sqrt(np.pi) * reach * np.exp(-square)
    return (erf(reach) - tail) @ _WEIGHTS, 2 * ((tail * square) @ _WEIGHTS) / radius
