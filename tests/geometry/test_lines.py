import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.common.geometry.lines import meeting_point, nearest_approach
from sightline.errors import ReconstructionRefusedError

FOCAL = np.array([13.7, -8.2, -617.3])
GRID = np.stack([*np.meshgrid([-66.0, -22, 22, 66], [-66.0, -22, 22, 66], [300.0])], axis=-1).reshape(-1, 3)


def test_lines_through_a_point_meet_there():
    np.testing.assert_allclose(meeting_point(GRID, GRID - FOCAL), FOCAL, atol=1e-8)


@pytest.mark.parametrize(
    ("origins", "directions", "words"),
    [
        (GRID, np.broadcast_to([0.0, 0, 1], GRID.shape), "nearly parallel"),
        (GRID, GRID - [0, 0, -1e6], "nearly parallel"),
        (GRID[:1], GRID[:1], "one line"),
        (GRID, np.zeros_like(GRID), "no direction"),
    ],
)
def test_lines_without_a_meeting_point_are_refused(origins, directions, words):
    with pytest.raises(ReconstructionRefusedError, match=words):
        meeting_point(origins, directions)


coordinate = st.floats(-500, 500)
vector = st.tuples(coordinate, coordinate, coordinate)


@given(vector, vector, vector, vector)
def test_nearest_approach_is_perpendicular_to_both_lines(o1, d1, o2, d2):
    o1, d1, o2, d2 = (np.array(v) for v in (o1, d1, o2, d2))
    lengths = np.linalg.norm(d1), np.linalg.norm(d2)
    if min(lengths) < 1 or np.linalg.norm(np.cross(d1, d2)) < 0.05 * lengths[0] * lengths[1]:
        return
    met = nearest_approach(o1, d1, o2, d2)
    between = met.second_mm - met.first_mm
    for direction, length in zip((d1, d2), lengths, strict=True):
        assert abs(between @ direction) / length < 1e-6
    for point, origin, direction, length in ((met.first_mm, o1, d1, lengths[0]), (met.second_mm, o2, d2, lengths[1])):
        assert np.linalg.norm(np.cross(point - origin, direction)) / length < 1e-6
    np.testing.assert_allclose(met.gap_mm, np.linalg.norm(between))


def test_parallel_lines_of_sight_are_refused():
    nearly = np.array([0.0, np.tan(np.radians(0.9)), 1.0])
    with pytest.raises(ReconstructionRefusedError, match="parallel"):
        nearest_approach(np.zeros(3), np.array([0.0, 0, 1]), np.ones(3), nearly)
