import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from sightline.common.geometry.covariance import both_within, ellipsoid_factor, length_quantile


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.99])
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_isotropic_lengths_are_chi_distributed(probability, dimension):
    quantile = length_quantile(4.0 * np.eye(dimension), probability)
    np.testing.assert_allclose(quantile, 2 * stats.chi.ppf(probability, dimension), rtol=1e-6)
    np.testing.assert_allclose(ellipsoid_factor(probability, dimension), stats.chi.ppf(probability, dimension))


@pytest.mark.parametrize("variances", [(1, 0.3, 0.01), (1, 1e-4, 0), (1, 1, 1e-6), (0.5, 1, 0), (9, 0, 0)])
def test_quantile_holds_its_share_of_samples(variances):
    rng = np.random.default_rng(3)
    turn = Rotation.random(rng=rng).as_matrix()
    lengths = np.linalg.norm(rng.normal(size=(400_000, 3)) * np.sqrt(variances), axis=1)
    for probability in (0.5, 0.95, 0.99):
        share = (lengths < length_quantile(turn @ np.diag(variances) @ turn.T, probability)).mean()
        # Three standard errors of a share of 400 000 samples.
        assert abs(share - probability) < 3 * np.sqrt(probability * (1 - probability) / 400_000)


@given(st.floats(1e-3, 1), st.floats(1e-3, 1))
def test_the_sum_of_two_exponentials_is_known_in_closed_form(a, b):
    """Reference for variances a, a, b: exponential in the plane, integrated over a Gaussian along the third axis."""
    radius = length_quantile(np.diag([a, a, b]), 0.9)
    z = np.linspace(-1, 1, 20001)[1:-1] * radius
    inside = stats.norm.pdf(z, scale=np.sqrt(b)) * -np.expm1(-(radius**2 - z**2) / (2 * a))
    np.testing.assert_allclose(np.trapezoid(inside, z), 0.9, atol=1e-5)


def test_many_covariances_at_once_and_none_at_all():
    variances = np.random.default_rng(0).uniform(0.1, 1, (6, 1, 1)) * np.eye(3)
    np.testing.assert_allclose(length_quantile(variances), [length_quantile(one) for one in variances])
    assert length_quantile(np.zeros((3, 3))) == 0


def test_a_negative_variance_is_refused():
    with pytest.raises(ValueError, match="negative variance"):
        length_quantile(np.diag([1.0, 1.0, -0.1]))


def test_two_plane_errors_are_both_short_with_the_share_of_samples():
    rng = np.random.default_rng(3)
    for _ in range(4):
        root = rng.standard_normal((4, 4)) * rng.uniform(0.02, 0.15, 4)
        off = np.linalg.norm((root @ rng.standard_normal((4, 400_000))).reshape(2, 2, -1), axis=1)
        share = float((off < 0.3).all(axis=0).mean())
        assert both_within(root @ root.T, 0.3) == pytest.approx(share, abs=0.003)  # 4 s.d. of the share


def test_equal_and_independent_plane_errors_have_known_shares():
    alone = 1 - np.exp(-0.5 * (0.5 / 0.2) ** 2)  # Rayleigh
    apart, same = 0.04 * np.eye(4), 0.04 * np.kron(np.ones((2, 2)), np.eye(2))
    assert both_within(apart, 0.5) == pytest.approx(alone**2, abs=1e-4)
    assert both_within(same, 0.5) == pytest.approx(alone, abs=1e-6)
    assert both_within(np.zeros((4, 4)), 0.5) == 1.0
    with pytest.raises(ValueError, match="negative"):
        both_within(np.diag([1.0, 1.0, 1.0, -0.1]), 0.5)
