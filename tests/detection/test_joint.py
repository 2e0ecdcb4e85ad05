import numpy as np
import pytest

from sightline.detection.labelling.joint import Places, first_focal

FOCAL = np.array([0.137, -0.082, 5.713])  # of the sheet: a unit is the field's radius
SIDE = np.linspace(-0.62, 0.57, 4)
PLATE = np.stack([*np.meshgrid(SIDE, SIDE)], axis=-1).reshape(-1, 2)
HEIGHT = 1.83
BOTH = Places(np.vstack([np.c_[PLATE, np.zeros(16)], np.c_[PLATE, np.full(16, HEIGHT)]]), 16, 3.0)


def seen_from(focal: np.ndarray) -> np.ndarray:
    """Return the images (16, 2) of the source plate's beads on the XRII plate."""
    return PLATE + HEIGHT / (HEIGHT - focal[2]) * (focal[:2] - PLATE)


def test_the_lines_of_the_source_beads_meet_in_the_focal_point():
    at = np.vstack([seen_from(FOCAL), PLATE, [[0.3, 0.4]]])
    on = np.concatenate([np.arange(16, 32), np.arange(16), [-1]])  # XRII beads and others do not count
    np.testing.assert_allclose(first_focal(BOTH, at, on), FOCAL, rtol=1e-12)


def test_the_focal_point_is_nearest_to_lines_that_do_not_meet():
    """Fails where a line's distance is not measured across it."""
    at, on = seen_from(FOCAL) + np.random.default_rng(5).normal(0.0, 0.01, (16, 2)), np.arange(16, 32)
    origin, along = BOTH.xyh[16:], BOTH.xyh[16:] - np.c_[at, np.zeros(16)]
    across = np.eye(3) - np.einsum("na,nb->nab", along, along) / (along**2).sum(axis=1)[:, None, None]
    nearest = np.linalg.solve(across.sum(axis=0), np.einsum("nab,nb->a", across, origin))
    np.testing.assert_allclose(first_focal(BOTH, at, on), nearest, rtol=1e-10)
    assert np.abs(nearest - FOCAL).max() > 1e-3


@pytest.mark.parametrize("count", [0, 1, 16])
def test_lines_that_meet_nowhere_give_the_origin(count: int):
    """A focal point at infinity, and too few beads: `settle` refuses a focal point of no height."""
    on = np.where(np.arange(16) < count, np.arange(16, 32), -1)
    at = seen_from(np.array([0.0, 0.0, 1e7])) if count > 1 else PLATE
    np.testing.assert_array_equal(first_focal(BOTH, at, on), np.zeros(3))


def test_one_plate_has_a_focal_point_off_it():
    alone = Places(BOTH.xyh[:16], 16, 3.0)
    assert first_focal(alone, PLATE, np.arange(16))[2] != 0.0
