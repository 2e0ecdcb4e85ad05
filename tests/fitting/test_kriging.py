"""Kriging against its definition: data left out one by one, and the dense system."""

import numpy as np
import pytest

from sightline.calibration import fit_map
from sightline.common import fitting as kriging
from sightline.common.fitting import (
    Kriging,
    PlanarKriging,
    cholesky,
    squared_distances,
    squared_exponential,
    variance_ratio,
)
from sightline.errors import CalibrationRefusedError

N, SHARED = 30, 3


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, (N, 2))


@pytest.fixture(scope="module")
def covariance(points) -> np.ndarray:
    return squared_exponential(squared_distances(points, points), 0.4) + 0.01 * np.eye(N)


@pytest.fixture(scope="module")
def planar(points, covariance) -> dict[str, np.ndarray]:
    """A model z = X theta + C shared + g + noise: data, design, columns, and prior precision of `shared`."""
    rng = np.random.default_rng(2)
    design = np.column_stack([np.ones(N), points])
    return {
        "data": rng.normal(size=(N, 2)),
        "design": design,
        "columns": rng.normal(size=(N, 2, SHARED)),
        "precision": np.diag([0.0, 1.0, 4.0]),
    }


def both(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix for both coordinates, interleaved."""
    return np.kron(matrix, np.eye(2))


def whole_system(covariance: np.ndarray, planar: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V^-1, all columns X, and (X^T V^-1 X + prior precision)^-1, for both coordinates as one vector."""
    inverse = np.linalg.inv(both(covariance))
    columns = np.hstack([both(planar["design"]), planar["columns"].reshape(2 * N, -1)])
    prior = np.zeros((columns.shape[1], columns.shape[1]))
    prior[-SHARED:, -SHARED:] = planar["precision"]
    return inverse, columns, np.linalg.inv(columns.T @ inverse @ columns + prior)


def test_every_pair_is_predicted_by_the_others_alone(covariance, planar) -> None:
    made = PlanarKriging.of(covariance, **planar).left_out()
    for k in (0, 11, N - 1):
        kept = np.arange(N) != k
        rest = PlanarKriging.of(
            covariance[np.ix_(kept, kept)],
            planar["data"][kept],
            design=planar["design"][kept],
            columns=planar["columns"][kept],
            precision=planar["precision"],
        )
        cross = covariance[k, kept][None]
        found = planar["design"][k] @ rest.theta + planar["columns"][k] @ rest.shared + (cross @ rest.dual)[0]
        np.testing.assert_allclose(made.residual[k], planar["data"][k] - found, rtol=1e-9)


def test_both_coordinates_are_solved_as_one_system(covariance, planar) -> None:
    made = PlanarKriging.of(covariance, **planar)
    inverse, columns, unknown = whole_system(covariance, planar)
    p = inverse - inverse @ columns @ unknown @ columns.T @ inverse
    np.testing.assert_allclose(made.dual.ravel(), p @ planar["data"].ravel(), rtol=1e-8, atol=1e-8)
    found = unknown @ columns.T @ inverse @ planar["data"].ravel()
    np.testing.assert_allclose(np.append(made.theta.ravel(), made.shared), found, rtol=1e-8)
    blocks = np.einsum("iaib->iab", p.reshape(N, 2, N, 2))
    left_out = made.left_out()
    np.testing.assert_allclose(left_out.variance, np.trace(np.linalg.inv(blocks), axis1=1, axis2=2) / 2, rtol=1e-8)
    expected = np.einsum("ia,iab,ib->i", left_out.residual, blocks, left_out.residual)
    np.testing.assert_allclose(left_out.m2, expected, rtol=1e-8)


def test_variances_are_those_of_the_one_system(points, covariance, planar) -> None:
    """Return the variance of theta and g at other points: prior, minus information, plus that of the columns."""
    at = np.array([[0.1, 0.2], [0.9, -0.9]])
    cross = squared_exponential(squared_distances(at, points), 0.4)
    design = np.column_stack([np.ones(2), at])
    made = PlanarKriging.of(covariance, **planar).variances(cross, np.ones(2), design)
    inverse, columns, unknown = whole_system(covariance, planar)
    there = np.hstack([both(design), np.zeros((4, SHARED))]) - both(cross) @ inverse @ columns
    total = np.eye(4) - both(cross) @ inverse @ both(cross).T + there @ unknown @ there.T
    np.testing.assert_allclose(made, np.diag(total).reshape(2, 2).mean(axis=1), rtol=1e-8)


def test_without_unknowns_it_is_simple_kriging(covariance, planar) -> None:
    made = PlanarKriging.of(covariance, planar["data"])
    np.testing.assert_allclose(made.dual, np.linalg.solve(covariance, planar["data"]), rtol=1e-9)
    own = np.diag(np.linalg.inv(covariance))
    np.testing.assert_allclose(made.left_out().residual, made.dual / own[:, None], rtol=1e-9)
    np.testing.assert_allclose(made.left_out().variance, 1 / own, rtol=1e-9)


def test_many_data_are_fitted_as_few_are(monkeypatch, points, covariance, planar) -> None:
    """Fails where one of both ways, by elimination and by LAPACK, takes the factor for its inverse."""
    few = Kriging.of(planar["design"], covariance, planar["data"])
    monkeypatch.setattr(kriging, "_AT_ONCE", N - 1)
    many = Kriging.of(planar["design"], covariance, planar["data"])
    assert few.inverted
    assert not many.inverted
    for name in ("white", "r", "theta", "dual", "solved", "_inverse"):
        np.testing.assert_allclose(getattr(few, name), getattr(many, name), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(few.precision(), many.precision(), rtol=1e-9)
    np.testing.assert_allclose(few.solved, np.linalg.solve(covariance, planar["design"]).T, rtol=1e-8, atol=1e-9)


def test_every_tail_is_scored_as_a_column_of_its_own(points, covariance) -> None:
    """Fails where a tail begins at another row, or where theta's part is not taken away."""
    rng = np.random.default_rng(4)
    data, pairs, order = rng.normal(size=(2 * N, 1)), rng.normal(size=(N, 2)), rng.permutation(N)
    design, whole = both(np.column_stack([np.ones(N), points])), both(covariance)
    first = np.array([0, 6, 17, N - 1])
    found, sd = Kriging.of(design, whole, data).score_tails(pairs, order, first)
    inverse = np.linalg.inv(whole)
    fixed = inverse - inverse @ design @ np.linalg.solve(design.T @ inverse @ design, design.T @ inverse)
    for k, begins in enumerate(first):
        direction = np.zeros((N, 2))
        direction[order[begins:]] = pairs[order[begins:]]
        precision = direction.ravel() @ fixed @ direction.ravel()
        assert found[k] == pytest.approx(direction.ravel() @ fixed @ data[:, 0] / precision, rel=1e-9)
        assert sd[k] == pytest.approx(precision**-0.5, rel=1e-9)


def test_the_diagonal_of_a_prediction(points, covariance, planar) -> None:
    made = Kriging.of(planar["design"], covariance, planar["data"])
    at = np.random.default_rng(3).uniform(-1, 1, (4, 2))
    design, cross = np.column_stack([np.ones(4), at]), squared_exponential(squared_distances(at, points), 0.4)
    prior = squared_exponential(squared_distances(at, at), 0.4)
    weights, total = made.predict(design, cross, prior)
    np.testing.assert_allclose(made.variances(cross, np.diag(prior), design), np.diag(total), rtol=1e-9)
    np.testing.assert_allclose(weights @ planar["data"], design @ made.theta + cross @ made.dual, rtol=1e-8)


def test_the_variance_ratio_of_honest_errors_is_one() -> None:
    rng = np.random.default_rng(4)
    m2 = (rng.normal(size=(100_000, 2)) ** 2).sum(axis=1)
    assert abs(variance_ratio(m2) - 1) < 0.02
    assert abs(variance_ratio(9 * m2) - 9) < 0.2


def test_what_is_not_positive_definite_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        cholesky(np.array([[1.0, 2.0], [2.0, 1.0]]))
    uv = np.repeat(np.random.default_rng(5).uniform(0, 1000, (20, 2)), 2, axis=0)
    with pytest.raises(CalibrationRefusedError, match="ill-conditioned"):
        fit_map(uv, 0.2 * uv, noise_px=1e-9)
