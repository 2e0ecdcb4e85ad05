import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.common.geometry.lines import meeting_point, nearest_approach
from sightline.errors import ReconstructionRefusedError

FOCAL = np.array([13.7, -8.2, -617.3])
GRID = np.stack([*np.meshgrid([-66.0, -22, 22, 66], [-66.0, -22, 22, 66], [300.0])], axis=-1).reshape(-1, 3)


def test_lines_through_a_point_meet_there():
    met = meeting_point(GRID, GRID - FOCAL)
    np.testing.assert_allclose(met.point_mm, FOCAL, atol=1e-8)
    np.testing.assert_allclose(met.distance_mm, 0, atol=1e-8)


def lines_with_errors(sd_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return origins shifted perpendicular to their lines."""
    return GRID + rng.normal(size=GRID.shape) * sd_mm[:, None]


@pytest.mark.parametrize("weighted", [True, False])
def test_covariance_of_the_meeting_point_by_sampling(weighted):
    rng = np.random.default_rng(5)
    sd = np.linspace(0.02, 0.2, 16) if weighted else np.full(16, 0.1)
    met = [meeting_point(lines_with_errors(sd, rng), GRID - FOCAL, sd_mm=sd if weighted else None) for _ in range(2000)]
    errors = np.array([one.point_mm - FOCAL for one in met])
    stated = np.mean([one.covariance_mm2 for one in met], axis=0)
    root = np.linalg.inv(np.linalg.cholesky(stated))
    # 2000 samples: a variance is known to 3.2 %, a correlation to 0.022; two standard errors.
    np.testing.assert_allclose(root @ np.cov(errors.T) @ root.T, np.eye(3), atol=0.07)
    np.testing.assert_allclose(root @ errors.mean(axis=0), 0, atol=0.05)


def test_weights_favour_the_certain_lines():
    rng = np.random.default_rng(6)
    sd = np.where(np.arange(16) < 12, 0.02, 1.0)
    squared = [
        [np.sum((meeting_point(origins, GRID - FOCAL, sd_mm=w).point_mm - FOCAL) ** 2) for w in (sd, None)]
        for origins in (lines_with_errors(sd, rng) for _ in range(200))
    ]
    weighted, unweighted = np.mean(squared, axis=0)
    assert weighted < unweighted / 10


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
