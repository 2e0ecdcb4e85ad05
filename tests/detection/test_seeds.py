"""The similarity of a plate and its beads, from which a labelling grows."""

import numpy as np
import pytest

from sightline.detection.labelling.seeds import best_similarity


@pytest.mark.parametrize("mirror", [False, True])
def test_a_similarity_is_found_of_points_beside_their_origin(mirror: bool) -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(-30.0, 50.0, (9, 2)) + np.array([70.0, -20.0])
    across = xy * [1.0, -1.0] if mirror else xy
    turn, size, shift = 0.7, 5.3, np.array([612.0, 380.0])
    c, s = size * np.cos(turn), size * np.sin(turn)
    uv = across @ np.array([[c, s], [-s, c]]) + shift
    found = best_similarity(xy, uv + 0.1 * rng.standard_normal(uv.shape))
    assert found.mirror is mirror
    assert (abs(found.rotation), np.angle(found.rotation)) == pytest.approx((size, turn), abs=0.01)
    assert (found.shift.real, found.shift.imag) == pytest.approx(tuple(shift), abs=1.0)
