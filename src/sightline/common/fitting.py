"""Fits: robust statistics, triangular systems, distances, and linear models with a Gaussian process (kriging).

Cholesky factors, triangular systems and least squares are direct LAPACK calls: for a hundred rows, wrappers double the
time. The model is z = X theta + g + noise, with unknown theta and Gaussian g and noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs

MEDIAN_M2 = 1.386  # of chi-square with two degrees of freedom, 2 ln 2; more digits would change stored estimates
MAD_TO_SD = 1.4826  # s.d. of a normal distribution over its median absolute deviation
MEDIAN_SD = 1.2533  # s.d. of the median over that of the mean (normal distribution)


def median(values: np.ndarray) -> float:
    """Return the median of (N,); np.median takes ten times as long on a hundred values."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def quantiles(values: np.ndarray, shares: Sequence[float]) -> list[float]:
    """Return the quantiles of (N,) at these shares, linear between values; np.quantile takes ten times as long."""
    places = np.arange(len(values))
    return np.interp(places[-1] * np.array(shares), places, np.sort(values)).tolist()


def variance_ratio(m2: np.ndarray) -> float:
    """Return the ratio of actual to stated variances of two-dimensional errors, from their squared Mahalanobis lengths
    (N,)."""
    return median(m2) / MEDIAN_M2


_UNDIVIDED = 64  # largest block that is not divided
_potrf, _trtri, _trtrs, _gelsy, _gelsy_lwork = get_lapack_funcs(
    ("potrf", "trtri", "trtrs", "gelsy", "gelsy_lwork"), dtype=np.float64
)
(_trmm,) = get_blas_funcs(("trmm",), dtype=np.float64)


def cholesky(matrix: np.ndarray) -> np.ndarray:
    """Return the lower factor (n, n), zero above. Raises np.linalg.LinAlgError if `matrix` is not positive definite."""
    if not len(matrix):
        return matrix
    factor, info = _potrf(matrix.T, lower=1)  # the transpose of a C array needs no reordering
    if info:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return factor


def solve_lower(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return factor^-1 @ right for a lower triangular factor."""
    return _trtrs(factor, right, lower=1)[0] if right.size else right


def solve_lower_transposed(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return factor^-T @ right for a lower triangular factor."""
    return _trtrs(factor, right, lower=1, trans=1)[0] if right.size else right


def inverse_lower(factor: np.ndarray) -> np.ndarray:
    """Return the inverse of a lower triangular factor, by halving: twice as fast as trtri for hundreds of rows."""
    n = len(factor)
    if n <= _UNDIVIDED:
        return _trtri(factor, lower=1)[0]
    h = n // 2
    inverse = np.zeros((n, n), order="F")
    first, second = inverse_lower(factor[:h, :h]), inverse_lower(factor[h:, h:])
    inverse[:h, :h], inverse[h:, h:] = first, second
    inverse[h:, :h] = _trmm(-1.0, second, _trmm(1.0, first, factor[h:, :h], side=1, lower=1), lower=1)
    return inverse


def least_squares(design: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients (m,) for data (n,), and the lower factor r (m, m) of design^T design = r r^T.

    Raises np.linalg.LinAlgError.
    """
    r = cholesky(design.T @ design)
    return solve_lower_transposed(r, solve_lower(r, design.T @ data)), r


def minimum_norm(design: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Return the coefficients (m, c) of least norm for data (n, c), n >= m: as np.linalg.lstsq, in a third of the time.

    A QR decomposition with pivots takes the place of singular values.
    """
    n, m = design.shape
    rounding = np.finfo(np.float64).eps * n
    space = int(_gelsy_lwork(n, m, data.shape[1], rounding)[0])
    return _gelsy(design, data, np.zeros((m, 1), np.int32), rounding, space)[1][:m]


def terms(degree: int) -> int:
    """Return the number of monomials of two variables up to a degree."""
    return (degree + 1) * (degree + 2) // 2


def monomials(xy: np.ndarray, degree: int) -> np.ndarray:
    """Return (N, terms): x^i y^j with i + j <= degree, by increasing degree."""
    powers = np.empty((degree + 1, 2, len(xy)))
    powers[0], powers[1:] = 1.0, np.transpose(xy)
    np.multiply.accumulate(powers, out=powers)
    i, j = exponents(degree)
    return np.ascontiguousarray((powers[i, 0] * powers[j, 1]).T)


@cache
def exponents(degree: int) -> np.ndarray:
    """Return (2, terms): i and j of `monomials`."""
    return np.array([(d - j, j) for d in range(degree + 1) for j in range(d + 1)]).T


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distances (N, M) between points (N, 2) and (M, 2)."""
    return np.hypot(a[:, 0, None] - b[:, 0], a[:, 1, None] - b[:, 1])


def exact_squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances (N, M) between points (N, 2) and (M, 2), exact also for close ones."""
    x, y = a[:, 0, None] - b[:, 0], a[:, 1, None] - b[:, 1]
    x *= x
    y *= y
    x += y
    return x


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the squared distances (N, M), by a matrix product: fast, but inexact for points close to each other."""
    squares = a @ (-2.0 * b.T)
    squares += np.einsum("ik,ik->i", a, a)[:, None]
    squares += np.einsum("ik,ik->i", b, b)
    return squares


def squared_exponential(squares: np.ndarray, length: float) -> np.ndarray:
    """Return exp(-d² / 2 length²) of squared distances d²: the covariance of a process of unit variance."""
    exponents = squares * (-0.5 / length**2)
    return np.exp(exponents, out=exponents)


_AT_ONCE = 400  # numbers whose matrices fit into a core's cache; LAPACK takes more than these in blocks [calc]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Leave-one-out residuals of N pairs of numbers, such as the coordinates of points.

    `residual` (N, 2): each pair minus its prediction from all others; `variance` (N,): the mean variance of both
    residuals; `m2` (N,): squared Mahalanobis length of the residual.
    """

    residual: np.ndarray
    variance: np.ndarray
    m2: np.ndarray

    @staticmethod
    def of(precision: np.ndarray, dual: np.ndarray) -> "LeftOut":
        """Return the residuals from P, the inverse covariance of the data z after fitting the unknowns.

        `precision` (3, N): entries xx, xy and yy of its diagonal blocks; `dual` (N, 2): the pairs of P z.
        """
        (a, b, c), (u, v) = precision, dual.T
        determinant = a * c - b * b
        residual = np.stack([c * u - b * v, a * v - b * u], axis=1) / determinant[:, None]
        return LeftOut(residual, (a + c) / (2 * determinant), (dual * residual).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Kriging:
    """Generalised least squares with universal kriging.

    V = cov(g) + cov(noise) = factor factor^T (n, n); `theta` (m, c) for data (n, c); `dual` (n, c): V^-1 (z - X theta);
    `white` (n, m) = factor^-1 X; `r` (m, m): the Cholesky factor of white^T white; `solved` (m, n) = X^T V^-1.
    `lower` (n, n): factor^-1 where `inverted`, else factor.
    """

    lower: np.ndarray
    inverted: bool
    white: np.ndarray
    r: np.ndarray
    theta: np.ndarray
    dual: np.ndarray
    solved: np.ndarray

    @staticmethod
    def of(design: np.ndarray, covariance: np.ndarray, data: np.ndarray) -> "Kriging":
        """Return the fit of data (n, c) with design (n, m), m from 0, and covariance (n, n).

        Raises np.linalg.LinAlgError where the covariance is not positive definite or the design is rank-deficient.
        """
        both, m = np.concatenate([design, data], axis=1), design.shape[1]
        if inverted := len(both) <= _AT_ONCE:
            lower, white, solved = _eliminated(covariance, both)
        else:
            lower = cholesky(covariance)
            white = solve_lower(lower, both)
            solved = solve_lower_transposed(lower, white).T
        white, z = white[:, :m], white[:, m:]
        r = cholesky(white.T @ white)
        theta = solve_lower_transposed(r, solve_lower(r, white.T @ z))
        rest = z - white @ theta
        dual = lower.T @ rest if inverted else solve_lower_transposed(lower, rest)
        return Kriging(lower, inverted, white, r, theta, dual, solved[:m])

    @cached_property
    def _inverse(self) -> np.ndarray:
        """factor^-1."""
        return self.lower if self.inverted else inverse_lower(self.lower)

    @cached_property
    def _back(self) -> np.ndarray:
        """(m, n): r^-1 X^T V^-1, so that P = factor^-T factor^-1 - back^T back (see `left_out`)."""
        return solve_lower(self.r, self.solved)

    def predict(self, design: np.ndarray, cross: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights (k, n) of the data in the prediction of design theta + g, and its covariance (k, k).

        `design` (k, m), `cross` (k, n) = cov(g, data) and `prior` (k, k) = cov(g), with g at the predicted points.
        """
        back, slope = self._halves(design, cross)
        weights = back @ self._inverse + slope @ self._back
        return weights, prior - back @ back.T + slope @ slope.T

    def variances(self, cross: np.ndarray, prior: np.ndarray, design: np.ndarray) -> np.ndarray:
        """Return the diagonal (k,) of `predict`'s covariance, from the prior variances `prior` (k,)."""
        back, slope = self._halves(design, cross)
        return prior - (back**2).sum(axis=1) + (slope**2).sum(axis=1)

    def _halves(self, design: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return factors (k, n) of the variance removed by the data, (k, m) of the variance added by unknown theta."""
        back = cross @ self._inverse.T
        return back, solve_lower(self.r, (design - back @ self.white).T).T

    def score_tails(self, pairs: np.ndarray, order: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the least-squares coefficient (k,) of each direction in the data (2N, 1), and its s.d. (k,).

        A direction is `pairs` (N, 2) in the pairs of rows `order`[first[k]:], and zero in the others. Each is fitted on
        its own, together with theta and g.
        """
        along = np.cumsum((pairs * self.dual.reshape(-1, 2)).sum(axis=1)[order[::-1]])[::-1]
        precision = _tail_precisions(self._inverse.T, self._back.T.copy(), pairs, order)
        return along[first] / precision[first], 1.0 / np.sqrt(precision[first])

    def left_out(self) -> LeftOut:
        """Return the leave-one-out residuals of each pair of the data (2N, 1).

        They follow from the diagonal blocks of P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1.
        """
        return LeftOut.of(_pair_precisions(self._inverse.T, self._back.T.copy()), self.dual.reshape(-1, 2))

    def precision(self) -> np.ndarray:
        """Return the diagonal (n,) of P: the inverse variances of the leave-one-out residuals of single numbers."""
        return (self._inverse**2).sum(axis=0) - (self._back**2).sum(axis=0)


@dataclass(frozen=True, eq=False)
class PlanarKriging:
    """Kriging of two coordinates with the same model and s shared unknowns: z = X theta + C shared + g + noise.

    `each`: the fit of both coordinates and the columns of C, without the shared unknowns. `shared` (s,); `theta` (m, 2)
    and `dual` (n, 2) as in `Kriging`, after fitting the shared unknowns. `spread` (s, s): a factor of their covariance.
    `pull` (n, 2, s): they reduce the inverse covariance of all data by `pull` times its transpose.
    """

    each: Kriging
    shared: np.ndarray
    spread: np.ndarray
    theta: np.ndarray
    dual: np.ndarray
    pull: np.ndarray

    @staticmethod
    def of(
        covariance: np.ndarray,
        data: np.ndarray,
        *,
        design: np.ndarray | None = None,
        columns: np.ndarray | None = None,
        precision: np.ndarray | None = None,
    ) -> "PlanarKriging":
        """Return the fit of data (n, 2); each coordinate has `covariance` (n, n) and `design` (n, m), C is `columns`.

        `precision` (s, s): inverse prior covariance of the shared unknowns about zero; by default they have no prior.
        Raises np.linalg.LinAlgError.
        """
        n = len(data)
        design = np.zeros((n, 0)) if design is None else design
        columns = np.zeros((n, 2, 0)) if columns is None else columns
        s = columns.shape[2]
        precision = np.zeros((s, s)) if precision is None else precision
        each = Kriging.of(design, covariance, np.concatenate([data, columns.reshape(n, 2 * s)], axis=1))
        rows, by_shared = columns.reshape(2 * n, s), each.dual[:, 2:].reshape(2 * n, s)
        covariance_of_shared = np.linalg.inv(precision + rows.T @ by_shared)
        shared = covariance_of_shared @ (by_shared.T @ data.reshape(2 * n))
        spread = np.linalg.cholesky(covariance_of_shared)
        theta = each.theta[:, :2] - (each.theta[:, 2:].reshape(2 * design.shape[1], s) @ shared).reshape(-1, 2)
        dual = each.dual[:, :2] - (by_shared @ shared).reshape(n, 2)
        pull = (by_shared @ spread).reshape(n, 2, s)
        return PlanarKriging(each, shared, spread, theta, dual, pull)

    def variances(self, cross: np.ndarray, prior: np.ndarray, design: np.ndarray | None = None) -> np.ndarray:
        """Return the mean variance (k,) of both coordinates, as `Kriging.variances`, with the shared unknowns' part."""
        design = np.zeros((len(cross), 0)) if design is None else design
        by_shared = cross @ self.each.dual[:, 2:] + design @ self.each.theta[:, 2:]
        added = by_shared.reshape(len(cross), 2, len(self.shared)) @ self.spread
        return self.each.variances(cross, prior, design) + (added**2).sum(axis=(1, 2)) / 2

    def left_out(self) -> LeftOut:
        """Return the leave-one-out residuals of each row of the data, both coordinates."""
        own = self.each.precision()
        return LeftOut.of(np.stack([own, np.zeros_like(own), own]) - _products(self.pull), self.dual)


def _products(pairs: np.ndarray) -> np.ndarray:
    """Return the inner products xx, xy and yy (3, N) of pairs of vectors (N, 2, k)."""
    x, y = pairs[:, 0], pairs[:, 1]
    return np.stack([np.einsum("nk,nk->n", a, b) for a, b in ((x, x), (x, y), (y, y))])


def _eliminated(covariance: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return factor^-1 (n, n), factor^-1 columns (n, k) and columns^T covariance^-1 (k, n).

    Raises np.linalg.LinAlgError.
    """
    inverse = inverse_lower(cholesky(covariance))
    white = inverse @ columns
    return inverse, white, white.T @ inverse


def _tail_precisions(inverse: np.ndarray, back: np.ndarray, pairs: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return d^T P d (N,) of the directions d = pairs[order[k:]]; `inverse` (n, n) and `back` (n, m): transposed."""
    x, y = pairs[order].T[:, :, None]
    total = np.zeros(len(order))
    for sign, rows in ((1.0, inverse), (-1.0, back)):
        along = x * rows[::2][order] + y * rows[1::2][order]
        total += sign * (np.cumsum(along[::-1], axis=0)[::-1] ** 2).sum(axis=1)
    return total


def _pair_precisions(inverse: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return entries xx, xy and yy (3, N) of the diagonal blocks of P; arguments as for `_tail_precisions`."""
    inner, fixed = (_products(np.stack([rows[::2], rows[1::2]], axis=1)) for rows in (inverse, back))
    return inner - fixed
