"""The edge of a metal tube in drawn images of beams of different hardness."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sightline.detection.metal_edges import MetalTube, find_outline, transmission
from sightline.imaging import Radiograph

LEFT_PX, DIAMETER_PX, BORE_PX, MM_PER_PX = 70.3, 58.0, 26.0, 0.19
FINE = 10  # samples per pixel


def _chord(u: np.ndarray, diameter_px: float) -> np.ndarray:
    off = np.clip(1 - ((u - LEFT_PX - DIAMETER_PX / 2) / (diameter_px / 2)) ** 2, 0.0, None)
    return diameter_px * np.sqrt(off) * MM_PER_PX


def _image(hardness: float) -> Radiograph:
    """A straight upright tube, blurred by 1 px, on even light with scatter and a little noise."""
    u = (np.arange(200 * FINE) + 0.5) / FINE - 0.5
    light = transmission(_chord(u, DIAMETER_PX) - _chord(u, BORE_PX), "titanium", hardness)
    row = gaussian_filter(light, FINE).reshape(200, FINE).mean(axis=1)
    noise = 60.0 * np.random.default_rng(2).standard_normal((180, 200))
    return Radiograph(np.rint(8000 + 20000 * row + noise).astype(np.uint16), 65535.0)


@pytest.mark.parametrize("off_px", [-19.0, 9.0, 19.0])
def test_a_stroke_a_third_of_the_width_beside_its_edge_finds_it(off_px):
    """8 pixels of a flat panel's image are 2.5 on a screen that shows it whole."""
    stroke, inside = np.array([[LEFT_PX + off_px, 10.0], [LEFT_PX + off_px, 170.0]]), np.array([100.0, 90.0])
    found = find_outline(_image(1.0), stroke, inside, MetalTube(DIAMETER_PX, BORE_PX, MM_PER_PX, "titanium", 1.0))
    assert abs(float(np.mean(found.uv_px[:, 0])) - LEFT_PX) < 0.1


@pytest.mark.parametrize("hardness", [0.7, 1.0])
def test_the_hardness_that_fits_best_is_near_the_true_one(hardness):
    stroke, inside = np.array([[72.1, 10.0], [68.8, 170.0]]), np.array([100.0, 90.0])
    found = {
        tried: find_outline(
            _image(hardness), stroke, inside, MetalTube(DIAMETER_PX, BORE_PX, MM_PER_PX, "titanium", tried)
        )
        for tried in (0.6, 0.7, 0.85, 1.0, 1.15)
    }
    best = min(found, key=lambda tried: found[tried].misfit)
    assert abs(best - hardness) < 0.16  # a step: blur and pixels' width take up the rest
    assert abs(float(np.mean(found[best].uv_px[:, 0])) - LEFT_PX) < 0.1
