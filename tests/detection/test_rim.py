"""The arithmetic of the test for a rim: medians by a sorting network, and values between pixels."""

import numpy as np
import pytest

from sightline.detection.beads import rim


@pytest.mark.parametrize("seed", range(3))
def test_the_sorting_network_finds_the_median(seed: int) -> None:
    """A network that lacks a comparison fails, also one that fails only where values are equal."""
    rng = np.random.default_rng(seed)
    scratch = np.empty(16, np.float32)
    for values in (rng.normal(size=(200, 16)), rng.integers(0, 3, size=(200, 16))):
        for row in values.astype(np.float32):
            assert rim._median(row, scratch) == pytest.approx(float(np.median(row)), abs=1e-7)


def test_values_between_pixels_are_bilinear_and_the_border_repeats() -> None:
    """On a plane bilinear values are exact, to float32; a program that mixes up rows and columns fails."""
    v, u = np.mgrid[:40, :60]
    image = (2.0 * u - 3.0 * v).astype(np.float32)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-5, 65, 500).astype(np.float32), rng.uniform(-5, 45, 500).astype(np.float32)
    expected = 2.0 * np.clip(x, 0, 58.99) - 3.0 * np.clip(y, 0, 38.99)
    values = np.empty(500, np.float32)
    sampler = rim._Sampler(image.reshape(-1), image.shape, x.copy(), y.copy(), np.empty(500, np.uint32), values)
    rim._interpolate(sampler, 500)
    np.testing.assert_allclose(values, expected, atol=1e-3)
