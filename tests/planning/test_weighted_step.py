"""The kernel's step equals that of the linearised solution, and leaves what it cannot compute to that."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sightline.errors import OutsideRegionError
from sightline.planning.points.picks import PickArrays
from sightline.planning.points.solution import Given, Solution, weighted_points

from .standin import StandInView, stand_in, turned

TARGETS_MM = np.array([[3.7, -11.2, 18.3], [-24.1, 27.9, -6.6], [11.8, 7.3, -14.2], [-8.6, -19.4, 5.9]])
SEEN = np.array([[1, 1, 1, 0], [1, 1, 0, 1], [1, 1, 1, 1]], dtype=bool)
OFF_MM = 2.0  # of the start, and so of the steps
ROUNDING_MM = 1e-10  # the same sums in another order, of places to 700 mm and inverses of a condition of 1e3


def _views() -> list[StandInView]:
    oblique = turned(turned(stand_in("pa", 0.1, 1.0, seed=9), "y", 40.0, ""), "x", 13.0, "oblique")
    return [stand_in("pa", 0.4, 1.0), stand_in("lateral", -0.2, 1.0), oblique]


def _given(count: int, *, snapped: bool, seed: int = 4) -> Given:
    """Picks with an error of their own in two or three views; the first point is snapped in the second."""
    rng, views = np.random.default_rng(seed), _views()[:count]
    seen = SEEN if count > 2 else np.ones((2, 4), dtype=bool)
    uv = np.array([view.project(TARGETS_MM) for view in views]) + rng.normal(0.0, 2.0, (count, 4, 2))
    half = rng.normal(0.0, 0.5, (count, 4, 2, 2)) + 0.3 * np.eye(2)
    across = np.zeros((count, 4, 2))
    if snapped:
        across[1, 0] = Rotation.from_euler("z", 0.7).apply([1.0, 0.0, 0.0])[:2]
    picks = PickArrays(np.where(seen[..., None], uv, np.nan), half @ np.swapaxes(half, -1, -2), across).regular()
    lines = [view.lines_of_sight(at[shown]) for view, at, shown in zip(views, picks.uv_px, seen, strict=True)]
    return Given(lines, picks)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("snapped", [False, True])
def test_its_steps_are_those_of_the_solution(count: int, snapped: bool) -> None:
    """Catches a block of the covariance, a pick or a snapped direction that the kernel leaves out or mixes up."""
    given = _given(count, snapped=snapped)
    start = TARGETS_MM + np.random.default_rng(1).normal(0.0, OFF_MM, TARGETS_MM.shape)
    expected = start
    for _ in range(2):
        expected = expected + Solution(given, expected, "weighted").step_mm()
    assert np.abs(expected - start).max() > OFF_MM  # the steps are as large as the start is off
    assert np.abs(weighted_points(given, start) - expected).max() < ROUNDING_MM


def test_a_point_behind_a_source_is_refused() -> None:
    """Catches a kernel that goes on where a depth is negative: the picks would get a place there."""
    given = _given(2, snapped=False)
    behind = TARGETS_MM.copy()
    behind[2] = 2.0 * given.lines[0].focal_point_mm - given.lines[0].points_mm[0]
    with pytest.raises(OutsideRegionError):
        weighted_points(given, behind)


def test_the_start_is_not_changed_and_the_result_is_the_same_again() -> None:
    """Catches a kernel that writes into what it was given, or into what it kept."""
    given = _given(3, snapped=True)
    start = TARGETS_MM.copy()
    first = weighted_points(given, start)
    assert np.array_equal(start, TARGETS_MM)
    assert np.array_equal(weighted_points(given, start), first)
