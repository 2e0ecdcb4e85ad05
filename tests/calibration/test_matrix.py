"""Views from another system's projection matrix."""

import numpy as np
import pytest
from calibration_scenes import TARGETS_MM

from sightline.calibration import view_from_matrix
from sightline.calibration.matrix_view import HomographyMap
from sightline.errors import UnusableInputError

FOCAL_MM = np.array([20.0, -14.0, -610.0])
INTRINSIC = np.array([[4700.0, 3.0, 520.0], [0.0, 4650.0, 500.0], [0.0, 0.0, 1.0]])
AXES = np.linalg.qr(np.array([[0.9, 0.3, 0.1], [0.3, -0.9, 0.05], [0.05, 0.1, 1.0]]))[0]
P = INTRINSIC @ AXES @ np.column_stack([np.eye(3), -FOCAL_MM])


def pixels(matrix: np.ndarray) -> np.ndarray:
    image = np.column_stack([TARGETS_MM, np.ones(len(TARGETS_MM))]) @ matrix.T
    return image[:, :2] / image[:, 2:]


def numbers(matrix: np.ndarray, like=None) -> np.ndarray:
    """Focal point and, on the plane of view `like`, the lines of the true pixels."""
    lines = view_from_matrix(matrix).lines_of_sight(pixels(P))
    plane = lines.plane if like is None else like.plane
    focal = lines.focal_point_mm
    reach = -plane.height_mm(focal) / (lines.directions @ plane.normal)
    return np.concatenate([focal, plane.to_plane(focal + reach[:, None] * lines.directions).ravel()])


@pytest.mark.parametrize("scale", [1.0, -2.5e-3])
def test_lines_run_from_the_focal_point_through_the_points_seen(scale):
    view = view_from_matrix(scale * P)
    np.testing.assert_allclose(view.focal_point_mm, FOCAL_MM, atol=1e-8)
    np.testing.assert_allclose(view.project(TARGETS_MM), pixels(P), atol=1e-8)
    lines = view.lines_of_sight(pixels(P))
    np.testing.assert_allclose(np.cross(TARGETS_MM - FOCAL_MM, lines.directions), 0.0, atol=1e-8)
    assert abs(view.plane.height_mm(np.zeros(3))) < 1e-9
    step = 1e-4
    ahead = view.plane_map.to_plane(pixels(P) + np.array([step, 0.0]))
    np.testing.assert_allclose(lines.jacobian[:, :, 0], (ahead - lines.xy_mm) / step, atol=1e-6)


def test_without_a_covariance_the_error_is_unknown():
    lines = view_from_matrix(P).lines_of_sight(pixels(P))
    assert lines.covariance is None
    assert not lines.shared


@pytest.mark.slow
def test_the_covariance_of_the_matrix_reaches_the_lines_as_sampling_shows():
    rng = np.random.default_rng(3)
    factor = 1e-4 * np.abs(P).ravel()[:, None] * rng.standard_normal((12, 12))
    view = view_from_matrix(P, factor @ factor.T)
    stated = sum(view.lines_of_sight(pixels(P)).covariance.values())
    draws = [numbers(P + (factor @ rng.standard_normal(12)).reshape(3, 4), view) for _ in range(2000)]
    sampled = np.cov(np.array(draws).T)
    scale = np.sqrt(np.diag(stated))
    np.testing.assert_allclose(np.sqrt(np.diag(sampled)) / scale, 1.0, atol=0.06)
    np.testing.assert_allclose(sampled / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.1)


def test_the_scale_of_the_matrix_carries_no_error():
    along = 1e-3 * P.ravel()
    lines = view_from_matrix(P, np.outer(along, along)).lines_of_sight(pixels(P))
    assert np.abs(sum(lines.covariance.values())).max() < 1e-12


@pytest.mark.parametrize(
    ("matrix", "covariance", "words"),
    [
        (np.eye(3), None, "shape"),
        (np.full((3, 4), np.nan), None, "finite"),
        (np.diag([1.0, 1.0, 0.0]) @ P + np.outer([0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]), None, "no focal point"),
        (np.vstack([P[0], P[0], P[2]]), None, "no focal point"),
        (INTRINSIC @ AXES @ np.column_stack([np.eye(3), -AXES[0]]), None, "depth of the CFCS origin"),
        (P, np.eye(11), r"\(12, 12\)"),
        (P, -np.eye(12), "not symmetric and positive"),
        (P, np.full((12, 12), np.inf), "finite"),
    ],
)
def test_invalid_matrices_are_refused(matrix, covariance, words):
    with pytest.raises(UnusableInputError, match=words):
        view_from_matrix(matrix, covariance)
    with pytest.raises(UnusableInputError, match="finite"):
        view_from_matrix(P).lines_of_sight(np.array([[np.nan, 1.0]]))


def test_a_matrix_sees_whatever_lies_before_its_source():
    view = view_from_matrix(P)
    points = np.concatenate([TARGETS_MM, FOCAL_MM[None], FOCAL_MM - 40.0 * AXES[2:]])
    uv, seen = view.project_seen(points)
    np.testing.assert_array_equal(seen, [*[True] * len(TARGETS_MM), False, False])
    np.testing.assert_allclose(uv, pixels(P), atol=1e-8)


def test_the_derivative_of_a_homography_of_any_tilt():
    """A matrix view's plane faces its detector; of a plane that does not, the depth changes with the pixel."""
    homography = HomographyMap(np.array([[4.1, -0.7, 503.0], [0.5, 3.8, 489.0], [1.3e-3, -0.9e-3, 1.0]]))
    uv = np.array([[214.3, 760.9], [803.2, 131.7]])
    xy, by_uv = homography.linearised(uv)
    np.testing.assert_allclose(homography.to_image(xy), uv, atol=1e-9)
    for axis, step in enumerate(1e-3 * np.eye(2)):
        difference = homography.to_plane(uv + step) - homography.to_plane(uv - step)
        np.testing.assert_allclose(by_uv[:, :, axis], difference / 2e-3, atol=1e-8)
