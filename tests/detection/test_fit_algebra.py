"""The sums of a bead's fit against NumPy: products through correlated noise, and the solution by Cholesky."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, convolve1d

from sightline.detection.beads.fit import _effective_parameters
from sightline.detection.beads.noise import LAGS
from sightline.detection.beads.refine import by_distance
from sightline.detection.beads.shadow import normal_equations, solve
from sightline.detection.beads.window import (
    CLIPPED,
    HIDDEN,
    NEAR_UNUSABLE,
    SEEN,
    along_both_axes,
    correlated_products,
    mark_near_unusable,
)


@pytest.mark.parametrize("reach", [0, 3, 6, 7])
def test_a_filter_of_any_length_is_a_convolution_along_both_axes(reach: int) -> None:
    rng = np.random.default_rng(8)
    field, taps = rng.normal(size=(23, 25)).astype(np.float32), rng.normal(size=reach + 1).astype(np.float32)
    whole = np.concatenate([taps[:0:-1], taps]).astype(np.float64)
    expected = convolve1d(convolve1d(field.astype(np.float64), whole, 0), whole, 1)
    inner = slice(reach, 23 - reach), slice(reach, 25 - reach)
    got = along_both_axes(field, taps)[:, : 25 - 2 * reach]
    np.testing.assert_allclose(got, expected[inner], rtol=0, atol=1e-5 * np.abs(whole).sum() ** 2)


@pytest.mark.parametrize("lags", [2, 3, 4])
def test_products_through_correlated_noise_are_those_of_convolved_fields(lags: int) -> None:
    # Fields that differ and are not symmetric: a program that swaps fields or axes, or drops the last lag, fails.
    rng = np.random.default_rng(5)
    side, correlation = 17, np.append(1.0, rng.uniform(-0.3, 0.5, lags)).astype(np.float32)
    u, v, w = fields = [np.pad(rng.normal(size=(side, side)), LAGS).astype(np.float32) for _ in range(3)]
    kernel = np.concatenate([correlation[:0:-1], correlation]).astype(np.float64)
    got = correlated_products(np.array([one.ravel() for one in fields]), correlation, side + 2 * LAGS)
    for product, one, other in zip(got, (u, u, v, w), (u, v, v, w), strict=True):
        convolved = convolve1d(
            convolve1d(other.astype(np.float64), kernel, 0, mode="constant"), kernel, 1, mode="constant"
        )
        size = float(np.linalg.norm(one) * np.linalg.norm(convolved))
        assert product == pytest.approx(float((one * convolved).sum()), abs=1e-5 * size)  # single precision, 600 terms


@pytest.mark.parametrize(("reach", "radius"), [(14.0, 9.0), (14.6, 6.0), (8.0, 3.0)])
@pytest.mark.parametrize("correlation", [(1.0, 0.0, 0.0), (1.0, 0.46, 0.03), (1.0, 0.7, 0.3, 0.1, 0.03)])
def test_effective_parameters_are_the_trace_through_correlated_noise(reach: float, radius: float, correlation) -> None:
    # A rim's derivatives and a cubic background, as in a window. A program that takes the noise for white finds 19
    # instead of 57 or 112; one that leaves out the other half of the window finds half.
    y, x = np.mgrid[-15.2:15.8, -14.7:16.3]
    where = np.array(np.nonzero(x**2 + y**2 < reach**2))
    x, y = x[tuple(where)] / reach, y[tuple(where)] / reach
    r, angle = np.hypot(x, y) * reach, np.arctan2(y, x)
    rim, inside = np.exp(-(((r - radius) / 0.8) ** 2)), r < radius
    terms = [rim * np.cos(k * angle + shift) for k, shift in ((0, 0), (1, 0), (1, 1.6), (2, 0), (2, 1.6))]
    terms += [rim * (r - radius), inside, inside * x, inside * y]
    terms += [~inside * x**a * y**b for a in range(4) for b in range(4 - a)]
    padded = -len(r) % 32
    columns = np.pad(np.array(terms), ((0, 0), (0, padded))).astype(np.float32)
    upper = np.linalg.cholesky(columns @ columns.T + 1e-3 * np.eye(len(columns))).T.copy()
    rows = np.zeros((len(columns), 31, 31))
    rows[:, *where] = np.linalg.solve(upper.T, columns)[:, : len(r)]
    kernel = np.array([*correlation[:0:-1], *correlation])
    through = convolve1d(convolve1d(rows, kernel, 1, mode="constant"), kernel, 2, mode="constant")
    got = _effective_parameters(
        columns, np.pad(where, ((0, 0), (0, padded))).astype(np.uint32), upper, by_distance(np.array(correlation))
    )
    assert got == pytest.approx((rows * through).sum(), rel=0.04)  # as the docstring states


@pytest.mark.parametrize("unknowns", [19, 20, 31])
def test_symmetric_equations_are_solved(unknowns: int) -> None:
    rng = np.random.default_rng(6)
    columns = rng.normal(size=(unknowns + 1, 40)).astype(np.float32)  # the derivatives, and the residuals
    jacobian, residual = columns[:-1].T.astype(np.float64), columns[-1].astype(np.float64)
    matrix, right = np.empty((unknowns, unknowns)), np.empty(unknowns)
    square = normal_equations(columns, matrix, right)
    np.testing.assert_allclose(matrix, jacobian.T @ jacobian, rtol=0, atol=1e-4)
    np.testing.assert_allclose(right, jacobian.T @ residual, rtol=0, atol=1e-4)
    assert square == pytest.approx(residual @ residual, rel=1e-5)
    upper, found = np.zeros(matrix.shape), np.zeros(unknowns)
    assert solve(np.triu(matrix), right, upper, found)
    symmetric = np.triu(matrix) + np.triu(matrix, 1).T  # single precision may differ between the two triangles
    np.testing.assert_allclose(found, np.linalg.solve(symmetric, right), rtol=1e-7)
    np.testing.assert_allclose(np.triu(upper), np.linalg.cholesky(symmetric).T, rtol=1e-7, atol=1e-9)


def test_equations_that_do_not_determine_every_unknown_are_refused() -> None:
    jacobian = np.random.default_rng(7).normal(size=(40, 5))
    jacobian[:, 3] = jacobian[:, 0] + jacobian[:, 1]
    matrix = jacobian.T @ jacobian
    assert not solve(matrix, np.ones(5), np.zeros((5, 5)), np.zeros(5))


@pytest.mark.parametrize("unusable", [[], [(9, 9)], [(0, 0), (18, 4)], [(2, 18), (3, 12), (17, 17)]])
def test_pixels_within_three_of_an_unusable_one_are_marked(unusable: list[tuple[int, int]]) -> None:
    # In corners too: a program that reads on from one row into the next, or one pixel less far, fails.
    state = np.full((19, 19), SEEN, np.uint8)
    for k, at in enumerate(unusable):
        state[at] = (HIDDEN, CLIPPED)[k % 2]
    bad, before = state >= CLIPPED, state.copy()
    reached = binary_dilation(bad, np.ones((7, 7), bool))
    lost = mark_near_unusable(state, 8.6, 9.2, 5.0)
    np.testing.assert_array_equal(state, np.where(bad, before, np.where(reached, NEAR_UNUSABLE, SEEN)))
    y, x = np.mgrid[:19, :19]
    rim = (np.abs(np.hypot(x - 8.6, y - 9.2) - 5.0) < 2.5) & (before != HIDDEN)
    assert lost == pytest.approx((rim & reached).sum() / rim.sum())
