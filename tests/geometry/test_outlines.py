"""Convex hulls of points."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sightline.calibration.maps.hull import Hull
from sightline.common.geometry.outlines import convex_hull, enclosed_area


@pytest.mark.parametrize("count", [3, 4, 9, 120])
@pytest.mark.parametrize("on_a_grid", [False, True])
def test_a_hull_is_that_of_qhull(count: int, on_a_grid: bool) -> None:
    """A corner left out, or a point on a side taken as one, fails it; so does the other direction of rotation."""
    rng = np.random.default_rng(count)
    for _ in range(20):
        points = rng.normal(size=(count, 2))
        if on_a_grid:
            points = np.unique(np.rint(3 * points), axis=0)
            if np.linalg.matrix_rank(points - points[0]) < 2:
                continue
        corners, expected = points[convex_hull(points)], ConvexHull(points)
        assert set(map(tuple, corners)) == set(map(tuple, points[expected.vertices]))
        after = np.roll(corners, -1, axis=0)
        assert (corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]).sum() / 2 == pytest.approx(expected.volume)
        assert enclosed_area(corners) == pytest.approx(expected.volume)
        assert enclosed_area(corners[::-1] + 1e6) == pytest.approx(expected.volume, rel=1e-8)  # far away, either way
        probes = 2 * rng.normal(size=(50, 2))
        sides = expected.equations
        distance = (probes @ sides[:, :2].T + sides[:, 2]).max(axis=1)
        np.testing.assert_allclose(Hull.of(points).distance_px(probes), distance, atol=1e-12)


def test_collinear_points_have_two_corners() -> None:
    along = np.random.default_rng(1).permutation(np.arange(7.0))
    assert sorted(convex_hull(np.stack([along, 0.0 * along], axis=1)).tolist()) == sorted(
        [int(along.argmin()), int(along.argmax())]
    )
