"""Twists and adjoints against the transforms themselves."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from sightline.common.geometry.rigid import adjoint, cross_matrix, displacement

numbers = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


@given(numbers, numbers)
def test_the_adjoint_carries_a_twist_through_a_pose(pose, twist):
    T = RigidTransform.from_exp_coords(pose)
    carried = RigidTransform.from_exp_coords(adjoint(T) @ twist)
    assert np.allclose((carried * T).as_matrix(), (T * RigidTransform.from_exp_coords(twist)).as_matrix(), atol=1e-9)


@given(numbers, numbers)
def test_points_move_as_their_displacement_says(points, twist):
    xyz, small = 50 * points.reshape(2, 3), 1e-6 * twist
    moved = RigidTransform.from_exp_coords(small).apply(xyz)
    assert np.allclose(moved - xyz, displacement(xyz) @ small, atol=1e-9)


def test_the_cross_matrix_is_the_cross_product():
    a, b = np.random.default_rng(1).standard_normal((2, 5, 3))
    assert np.allclose(np.einsum("nij,nj->ni", cross_matrix(a), b), np.cross(a, b))
