"""Linear model with a Gaussian-process part: z = X theta + g + noise, theta unknown, g and the noise Gaussian."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import get_lapack_funcs

from sightline.errors import CalibrationRefusedError

_UNDIVIDED = 64
_potrf, _trtri, _trtrs = get_lapack_funcs(("potrf", "trtri", "trtrs"), dtype=np.float64)


def cholesky(matrix: np.ndarray) -> np.ndarray:
    """Lower factor, zeros above. Raises CalibrationRefusedError where the matrix is not positive definite."""
    factor, info = _potrf(matrix.T, lower=1)  # the transpose of a C array needs no reordering
    if info:
        raise CalibrationRefusedError(
            "the beads' covariances make the calibration ill-conditioned; check the noise stated and double beads"
        )
    return factor


def solve_lower(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """factor^-1 @ right for a lower triangular factor."""
    return _trtrs(factor, right, lower=1)[0]


def solve_lower_transposed(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """factor^-T @ right for a lower triangular factor."""
    return _trtrs(factor, right, lower=1, trans=1)[0]


def inverse_lower(factor: np.ndarray) -> np.ndarray:
    """Inverse of a lower triangular factor, by halves: for some hundred rows in half the time of LAPACK's trtri."""
    n = len(factor)
    if n <= _UNDIVIDED:
        return _trtri(factor, lower=1)[0]
    h = n // 2
    out = np.zeros((n, n), order="F")
    out[:h, :h], out[h:, h:] = inverse_lower(factor[:h, :h]), inverse_lower(factor[h:, h:])
    out[h:, :h] = -out[h:, h:] @ (factor[h:, :h] @ out[:h, :h])
    return out


def least_squares(design: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (m,) for data (n,), and r (m, m) lower: design^T design = r r^T. Raises CalibrationRefusedError."""
    r = cholesky(design.T @ design)
    return solve_lower_transposed(r, solve_lower(r, design.T @ data)), r


@dataclass(frozen=True, eq=False)
class Solution:
    """Generalised least squares with universal kriging.

    `covariance` is cov(g) + cov(noise) (n, n) = factor factor^T; `theta` (m, c) for data (n, c);
    `dual` (n, c) = V^-1 (z - X theta); `white` (n, m) = factor^-1 X = q r.
    """

    factor: np.ndarray
    white: np.ndarray
    r: np.ndarray
    theta: np.ndarray
    dual: np.ndarray

    @staticmethod
    def of(design: np.ndarray, covariance: np.ndarray, data: np.ndarray) -> "Solution":
        """Data (n, c), design (n, m), covariance (n, n). Raises CalibrationRefusedError."""
        factor = cholesky(covariance)
        both = solve_lower(factor, np.concatenate([design, data], axis=1))
        white, z = both[:, : design.shape[1]], both[:, design.shape[1] :]
        r = cholesky(white.T @ white)
        theta = solve_lower_transposed(r, solve_lower(r, white.T @ z))
        return Solution(factor, white, r, theta, solve_lower_transposed(factor, z - white @ theta))

    @cached_property
    def _inverse(self) -> np.ndarray:
        """factor^-1."""
        return inverse_lower(self.factor)

    @cached_property
    def _fixed(self) -> np.ndarray:
        """(m, n): r^-1 white^T."""
        return solve_lower(self.r, self.white.T)

    def predict(self, design: np.ndarray, cross: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of design theta + g: the weights (k, n), by which it is the data's, and its covariance (k, k).

        `cross` = cov(g there, data), `prior` = cov(g there).
        """
        back = cross @ self._inverse.T
        slope = solve_lower(self.r, (design - back @ self.white).T).T
        weights = (back + slope @ self._fixed) @ self._inverse
        return weights, prior - back @ back.T + slope @ slope.T

    def score(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How much of each direction (n, k) is in the data beside the model: amounts (k,), and their s.d. (k,).

        Each by itself, by generalised least squares: theta and g are fitted with it.
        """
        white = solve_lower(self.factor, directions)
        fixed = solve_lower(self.r, self.white.T @ white)
        precision = (white**2).sum(axis=0) - (fixed**2).sum(axis=0)
        return directions.T @ self.dual[:, 0] / precision, 1.0 / np.sqrt(precision)

    def residual_precision(self, size: int) -> np.ndarray:
        """(n / size, size, size): diagonal blocks of P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1.

        The leave-one-out residual of block i is inv(P_ii) times its part of `dual`, and inv(P_ii) its covariance.
        """
        inverse = self._inverse
        fixed = self._fixed @ inverse
        whole, taken = (part.T.reshape(-1, size, part.shape[0]) for part in (inverse, fixed))
        return np.einsum("iak,ibk->iab", whole, whole) - np.einsum("iak,ibk->iab", taken, taken)
