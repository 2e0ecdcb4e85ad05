"""Cholesky factors, triangular systems, least squares by direct LAPACK calls: for a hundred rows, wrappers double the
time.
"""

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs

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
    out = np.zeros((n, n), order="F")
    first, second = inverse_lower(factor[:h, :h]), inverse_lower(factor[h:, h:])
    out[:h, :h], out[h:, h:] = first, second
    out[h:, :h] = _trmm(-1.0, second, _trmm(1.0, first, factor[h:, :h], side=1, lower=1), lower=1)
    return out


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
