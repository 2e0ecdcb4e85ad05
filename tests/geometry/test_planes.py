import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sightline.common.geometry.planes import Plane
from sightline.errors import OutsideRegionError, UnusableInputError


def grid(normal_axis: int) -> np.ndarray:
    """Return a 5 x 5 grid perpendicular to a space axis, at 150 mm."""
    line = np.linspace(-44.0, 44.0, 5)
    a, b = np.meshgrid(line, line)
    return np.roll(np.stack([a.ravel(), b.ravel(), np.full(25, 150.0)], axis=1), normal_axis + 1, axis=1)


@pytest.mark.parametrize(("normal_axis", "axes"), [(2, ("+X", "+Y")), (0, ("+Y", "+Z")), (1, ("+X", "-Z"))])
def test_axes_of_upright_plates(normal_axis, axes):
    named = {f"{sign}{name}": float(f"{sign}1") * np.eye(3)[i] for i, name in enumerate("XYZ") for sign in "+-"}
    plane = Plane.fit(grid(normal_axis))
    np.testing.assert_allclose(plane.axes, [named[axis] for axis in axes], atol=1e-12)
    np.testing.assert_allclose(plane.normal, np.eye(3)[normal_axis], atol=1e-12)


@given(
    axis=st.sampled_from([0, 1, 2]),
    tilt=st.tuples(*[st.floats(-0.002, 0.002)] * 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_neither_bead_order_nor_small_tilt_turns_the_axes(axis, tilt, seed):
    rng = np.random.default_rng(seed)
    points = rng.permutation(Rotation.from_rotvec(tilt).apply(grid(axis)) + rng.normal(0, 0.05, (25, 3)))
    np.testing.assert_allclose(Plane.fit(points).axes, Plane.fit(grid(axis)).axes, atol=0.01)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_both_signs_of_a_normal_give_one_plane_with_orthonormal_axes(normal):
    one, other = Plane.across(np.array(normal), np.zeros(3)), Plane.across(-np.array(normal), np.zeros(3))
    np.testing.assert_allclose(one.axes, other.axes)
    np.testing.assert_allclose(one.axes @ one.axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(np.abs(one.normal @ normal), np.linalg.norm(normal))


def test_space_and_plane_are_inverse():
    plane = Plane.across(np.array([0.3, -0.2, 0.9]), np.array([10.0, 20.0, 30.0]))
    xy = np.array([[1.0, 2.0], [-30.5, 17.25]])
    np.testing.assert_allclose(plane.to_plane(plane.to_space(xy)), xy, atol=1e-12)
    np.testing.assert_allclose(plane.height_mm(plane.to_space(xy) + 4 * plane.normal), 4.0, atol=1e-12)


def test_central_projection_lies_on_the_ray_and_on_the_plane():
    plane = Plane.across(np.array([0.1, 0.05, 1.0]), np.array([5.0, -3.0, 300.0]))
    focal = np.array([12.0, -7.0, -620.0])
    beads = np.random.default_rng(1).uniform((-60, -60, 90), (60, 60, 210), (20, 3))
    shadow = plane.to_space(plane.central_projection(focal, beads))
    np.testing.assert_allclose(plane.height_mm(shadow), 0, atol=1e-10)
    np.testing.assert_allclose(np.cross(shadow - focal, beads - focal) / 1e5, 0, atol=1e-12)


@pytest.mark.parametrize("bead", [[0.0, 0.0, -620.0], [10.0, 0.0, -700.0]])
def test_a_point_behind_the_focal_point_casts_no_shadow(bead):
    with pytest.raises(OutsideRegionError, match="casts no shadow"):
        Plane.fit(grid(2)).central_projection(np.array([0.0, 0.0, -620.0]), np.array([[0.0, 0, 0], bead]))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.eye(3)[:2], np.outer(np.arange(5.0), [1.0, 2, 3])])
def test_points_on_a_line_have_no_plane(points):
    with pytest.raises(UnusableInputError, match="one line"):
        Plane.fit(points)
