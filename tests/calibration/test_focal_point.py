"""The paper's focal point: where lines meet, and what moves it."""

import numpy as np
import pytest

from sightline.calibration.plates.classical import focal_point, focal_point_response
from sightline.errors import CalibrationRefusedError

FOCAL_MM = np.array([5.0, -9.0, -620.0])
FROM_MM = np.column_stack([np.random.default_rng(0).uniform(-60.0, 60.0, (20, 2)), np.full(20, 300.0)])
TO_MM = FOCAL_MM + (770.0 / 920.0) * (FROM_MM - FOCAL_MM)


def test_the_response_is_the_derivative():
    by_from, by_to = focal_point_response(FROM_MM, TO_MM, FOCAL_MM)
    rng, step = np.random.default_rng(1), 1e-5
    a, b = rng.standard_normal((2, 20, 3))
    moved = focal_point(FROM_MM + step * a, TO_MM + step * b) - focal_point(FROM_MM, TO_MM)
    told = np.einsum("nij,nj->i", by_from, a) + np.einsum("nij,nj->i", by_to, b)
    np.testing.assert_allclose(moved / step, told, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("from_mm", "to_mm", "words"),
    [
        (FROM_MM[:3], TO_MM[:3], "only 3 lines"),
        (FROM_MM, FROM_MM - [0.0, 0.0, 150.0], "parallel"),
    ],
)
def test_lines_that_meet_nowhere_are_refused(from_mm, to_mm, words):
    with pytest.raises(CalibrationRefusedError, match=words):
        focal_point(from_mm, to_mm)
