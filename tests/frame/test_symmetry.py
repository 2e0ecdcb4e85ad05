"""Symmetries of solids."""

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from sightline.frame.solid_shape import in_words, symmetry_of

CUBE = 20.0 * np.array(list(product((-1, 1), repeat=3)))
SCATTERED = np.random.default_rng(4).uniform(-30, 30, (5, 3))


def words(xyz_mm: np.ndarray, diameter_mm: np.ndarray | None = None, tolerance_mm: float = 0.5) -> list[str]:
    sizes = np.full(len(xyz_mm), 3.0) if diameter_mm is None else diameter_mm
    return [in_words(one) for one in symmetry_of(xyz_mm, sizes, tolerance_mm)]


def test_a_cube_has_its_47_symmetries_besides_the_identity() -> None:
    turned = CUBE @ Rotation.random(rng=np.random.default_rng(1)).as_matrix().T + [5.0, -3.0, 100.0]
    for xyz in (CUBE, turned):
        found = symmetry_of(xyz, np.full(8, 3.0), 0.5)
        assert len(found) == 47
        assert sum(np.linalg.det(one) > 0 for one in found) == 23


def test_quarter_turns_and_improper_rotations_are_named() -> None:
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    powers = [np.linalg.matrix_power(quarter @ np.diag([1.0, 1.0, -1.0]), k) for k in range(4)]
    cloud = np.concatenate([SCATTERED @ one.T for one in powers])
    assert sorted(words(cloud)) == [
        "rotated by 180° about z",
        "rotated by 90° about z and reflected along this axis",
        "rotated by 90° about z and reflected along this axis",
    ]


def test_a_ball_off_its_place_breaks_a_symmetry_beyond_the_tolerance_only() -> None:
    cloud = np.concatenate([SCATTERED, SCATTERED * [-1, -1, 1]])
    cloud[0, 2] += 1.0  # 0.9 mm after the shift of the centroid: 1 mm of the ball less 0.1 mm
    assert words(cloud, tolerance_mm=1.2) == ["rotated by 180° about z"]
    assert words(cloud, tolerance_mm=0.4) == []


def test_sizes_break_a_symmetry() -> None:
    cloud = np.concatenate([SCATTERED, SCATTERED * [-1, -1, 1]])
    sizes = np.full(10, 3.0)
    sizes[0] = 4.0
    assert words(cloud, sizes) == []
    sizes[5] = 4.0
    assert words(cloud, sizes) == ["rotated by 180° about z"]


def test_balls_in_a_plane_are_their_own_mirror_image() -> None:
    assert words(SCATTERED * [1, 0, 1]) == ["reflected in the plane perpendicular to y"]


def test_balls_on_a_line_have_a_symmetry() -> None:
    assert words(np.outer([-30.0, -10.0, 0.0, 5.0, 25.0, 10.0], [1.0, 0.0, 0.0]))
