"""The eye of the walks: an image is found where it is drawn, in any orientation, and no other is taken for it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom
from tests.app.picture import Shown, find

# Shapes as large as bones, and finer ones.
IMAGE, OTHER = (
    sum(sd * gaussian_filter(np.random.default_rng(seed).normal(size=(512, 512)), sd) for sd in (40.0, 15.0, 4.0))
    for seed in (3, 4)
)


def _screen(image: np.ndarray, shown: Shown) -> np.ndarray:
    """A screen of 400 x 640 with a panel beside the picture, the image drawn as a window of grey values shows it."""
    screen = np.full((400, 640), 20.0)
    screen[:, 500:] = 180.0
    drawn = shown.drawn(image, screen.shape, 1)
    there = np.isfinite(drawn)
    grey = (drawn[there] - image.min()) / np.ptp(image)
    screen[there] = 255.0 * np.clip(1.3 * grey - 0.1, 0.0, 1.0) ** 0.8
    return screen


@pytest.mark.parametrize(("mirrored", "quarters"), [(False, 0), (False, 1), (True, 0), (True, 3)])
def test_an_image_is_found_to_a_third_of_a_pixel(mirrored: bool, quarters: int):
    true = Shown(512, mirrored, quarters, 0.613, np.array([217.3, 203.9]), 1.0)
    found = find(IMAGE, _screen(IMAGE, true))
    assert (found.mirrored, found.quarters) == (mirrored, quarters)
    for uv in ((20.0, 30.0), (480.0, 31.0), (255.0, 490.0)):
        assert np.hypot(*np.subtract(found.at(uv), true.at(uv))) < 0.33


def test_a_turn_moves_the_corner_as_on_the_screen():
    """A quarter turn of the screen, clockwise, brings the image's upper left corner to the upper right."""
    image = zoom(np.array([[0.0, 1.0], [2.0, 3.0]]), 4, order=0)
    shown = Shown(8, False, 1, 1.0, np.array([3.5, 3.5]), 1.0)
    assert shown.at((0.0, 0.0)) == pytest.approx((7.0, 0.0))
    np.testing.assert_allclose(shown.drawn(image, (8, 8), 1), np.rot90(image, -1))


def test_another_image_is_not_found():
    true = Shown(512, False, 0, 0.613, np.array([217.3, 203.9]), 1.0)
    with pytest.raises(AssertionError, match="no picture on the screen is like this image"):
        find(OTHER, _screen(IMAGE, true))
