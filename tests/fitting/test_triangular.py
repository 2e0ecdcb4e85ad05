"""Direct calls of LAPACK give what NumPy gives."""

import numpy as np
import pytest

from sightline.common.fitting import cholesky, inverse_lower, minimum_norm


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 131, 300])
def test_an_inverse_is_that_of_the_factor(count: int) -> None:
    """A half that is multiplied from the wrong side, or with the wrong sign, fails it."""
    rows = np.random.default_rng(count).normal(size=(count, 2 * count))
    factor = cholesky(rows @ rows.T)
    inverse = inverse_lower(factor)
    np.testing.assert_allclose(inverse @ factor, np.eye(count), atol=1e-12)  # rounding of 300 products
    assert not np.triu(inverse, 1).any()


@pytest.mark.parametrize(("rows", "columns", "rank"), [(50, 21, 21), (30, 2, 2), (40, 6, 4), (21, 21, 21)])
def test_least_squares_are_those_of_numpy_also_without_full_rank(rows: int, columns: int, rank: int) -> None:
    """A program that takes the design as of full rank fails with numbers of 1e15."""
    rng = np.random.default_rng(rows)
    design = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns))
    data = rng.normal(size=(rows, 2))
    before = design.copy()
    expected = np.linalg.lstsq(design, data, rcond=None)[0]
    np.testing.assert_allclose(minimum_norm(design, data), expected, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(design, before)
