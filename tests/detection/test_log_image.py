"""The log image: what is filled in outside the field and under annotations."""

import numpy as np
import pytest

from sightline.detection.log_image import log_image
from sightline.imaging import Radiograph

WHITE = 4095


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_no_filled_pixel_is_brighter_than_a_clipped_one(kind) -> None:
    """Otherwise clipped pixels count as data. Averages in float32 exceeded the white level by their last digit."""
    at = np.arange(512) - 255.5
    field = np.hypot(at, at[:, None]) < 250
    pixels = np.where(at < -100, WHITE, 2000).astype(kind) * field.astype(kind)
    image = Radiograph(pixels, WHITE)
    logs = log_image(image, field)
    assert logs.max() == logs[field].max()
    assert np.count_nonzero(logs[field] == logs.max()) == np.count_nonzero(pixels == WHITE)
    assert logs[255, 0] == pytest.approx(np.log(WHITE), abs=0.01)  # and the fill still follows the inside
