"""Planning on views that another system calibrated: matrices, with and without a covariance."""

import numpy as np
import pytest

import sightline as sl
from sightline.errors import ReconstructionRefusedError
from sightline.planning import kind, matching_curve, plan

# Cameras 620 mm from the origin along -Z and along -X, 4760 px focal length.
CAMERA = np.array([[4760.0, 0.0, 511.5], [0.0, 4760.0, 511.5], [0.0, 0.0, 1.0]])
PA = CAMERA @ np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 620]])
LATERAL = CAMERA @ np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 620]])
TARGETS_MM = np.array([[14.2, -8.3, 21.7], [-19.6, 11.4, -25.2]])
COVARIANCE = np.diag((1e-6 * np.abs(PA).ravel() + 1e-9) ** 2)


def _pixels(matrix: np.ndarray) -> np.ndarray:
    homogeneous = np.column_stack([TARGETS_MM, np.ones(2)]) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


UV_PX = np.array([_pixels(PA), _pixels(LATERAL)])


def test_an_error_of_zero_is_refused():
    views = [sl.view_from_matrix(PA, 0.0 * COVARIANCE), sl.view_from_matrix(LATERAL, 0.0 * COVARIANCE)]
    assert np.isfinite(sl.reconstruct(views, UV_PX).covariance_mm2).all()
    with pytest.raises(ReconstructionRefusedError, match="singular"):
        sl.reconstruct(views, UV_PX, np.zeros((2, 2, 2, 2)))


def test_snapped_picks_on_exact_views():
    views = [sl.view_from_matrix(PA, 0.0 * COVARIANCE), sl.view_from_matrix(LATERAL, 0.0 * COVARIANCE)]
    trajectory = plan(views, UV_PX[:, 0], UV_PX[:, 1], procedure=kind("free-wire"), snapped=True).trajectory
    np.testing.assert_allclose(trajectory.points.xyz_mm, TARGETS_MM, atol=1e-3)
    assert not trajectory.points.gap_tested.any()


@pytest.mark.parametrize("k", [0, 1])
def test_the_curve_reaches_both_sides_of_the_reference_plane(k):
    """The plane of a matrix view passes through the origin: targets lie before and behind it."""
    views = [sl.view_from_matrix(PA, name="pa"), sl.view_from_matrix(LATERAL, name="lateral")]
    curve = matching_curve(views[0], UV_PX[0, k], views[1])
    assert np.linalg.norm(curve.xyz_mm - TARGETS_MM[k], axis=1).min() < 1.01
    assert np.linalg.norm(curve.uv_px - UV_PX[1, k], axis=1).min() < 8.0
