"""Elimination of a symmetric matrix against NumPy's products and inverses."""

import numpy as np
import pytest

from sightline.fitting.dense import PIVOTS, STRIDE, eliminate


def bordered(n: int, m: int, inverse: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return [[A, B, 1], [., C, 0]] with zeros up to whole steps, A (n, n) with its B (n, m); C is zero."""
    rng = np.random.default_rng([n, m])
    half = rng.normal(size=(n, 2 * n))
    a, b = half @ half.T, rng.normal(size=(n, m))
    matrix = np.zeros((n + m, -(-(n + m + n * inverse) // STRIDE) * STRIDE))
    matrix[:n, :n], matrix[:n, n : n + m] = a, b
    if inverse:
        matrix[:n, n + m : 2 * n + m] = np.eye(n)
    return matrix, a, b


@pytest.mark.parametrize(("n", "m"), [(4, 2), (8, 0), (12, 16), (16, 6), (108, 16), (212, 26)])
@pytest.mark.parametrize("inverse", [True, False])
def test_factor_solutions_and_inverse_are_those_of_numpy(n: int, m: int, inverse: bool) -> None:
    """Fails where a step leaves out the last columns, takes a row twice, or drops the identity's part too early."""
    matrix, a, b = bordered(n, m, inverse)
    assert eliminate(n, n + m, matrix)
    lower = np.linalg.cholesky(a)
    white = np.linalg.solve(lower, b)
    np.testing.assert_allclose(np.triu(matrix[:n, :n]), lower.T, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(matrix[:n, n : n + m], white, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.triu(matrix[n:, n : n + m]), -np.triu(white.T @ white), rtol=1e-9, atol=1e-12)
    if inverse:
        expected = np.linalg.inv(lower)
        np.testing.assert_allclose(matrix[:n, n + m : 2 * n + m], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(matrix[n:, n + m : 2 * n + m], -white.T @ expected, rtol=1e-9, atol=1e-12)


def test_what_is_below_the_diagonal_does_not_count() -> None:
    """Fails where the lower triangle is read, which callers do not fill."""
    matrix, _, _ = bordered(12, 4, True)
    other = matrix.copy()
    other[np.tril_indices(12, -1)] = 1e6
    other[12:, :12] = -1e6
    assert eliminate(12, 16, matrix)
    assert eliminate(12, 16, other)
    np.testing.assert_array_equal(np.triu(matrix[:12, :12]), np.triu(other[:12, :12]))
    np.testing.assert_array_equal(np.triu(matrix[12:, 12:16]), np.triu(other[12:, 12:16]))
    np.testing.assert_array_equal(matrix[:, 16:], other[:, 16:])


@pytest.mark.parametrize("row", [0, 3, PIVOTS, 11])
@pytest.mark.parametrize("pivot", [0.0, -1.0, np.nan])
def test_a_matrix_that_is_not_positive_is_told(row: int, pivot: float) -> None:
    matrix = np.zeros((12, STRIDE))
    matrix[:, :12] = np.eye(12)
    matrix[row, row] = pivot
    assert not eliminate(12, 12, matrix)
