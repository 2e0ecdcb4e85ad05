"""Compressed, quantised and partly constant images give beads within their errors, or a refusal that says why."""

from collections.abc import Callable

import numpy as np
import pytest
from degraded_images import banded, blocks, in_8_bits, jpeg, levels
from track_images import FRAME, beads, image

from sightline.detection import Observations, detect, label, look_again
from sightline.detection.noise import LAGS, NoiseModel
from sightline.errors import DetectionRefusedError, SightlineError
from sightline.imaging import Radiograph

TRUTH = beads()
CLEAN = in_8_bits(image(TRUTH, 5))


def labelled(pixels: np.ndarray) -> Observations:
    one = Radiograph(pixels, 255.0)
    found = detect(one)
    return look_again(one, found, label(found, FRAME), FRAME)


def squares(found: Observations) -> np.ndarray:
    """(N,) half the squared normalised errors; 1 on average where the stated covariance is true."""
    assert found.covariance_px2 is not None
    off = found.uv_px - [(TRUTH[name].u, TRUTH[name].v) for name in found.ids]
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance_px2), off) / 2


@pytest.mark.parametrize("quality", [20, 35, 50, 65, 80, 95])
def test_beads_of_compressed_images_are_within_their_errors(quality: int) -> None:
    found = labelled(jpeg(CLEAN, quality))
    assert len(found) > 0.5 * len(TRUTH)
    assert np.median(squares(found)) / np.log(2) < 1.5


@pytest.mark.parametrize("side", [2, 4, 8])
@pytest.mark.parametrize("quality", [1, 5, 10, 20, 30])
def test_whatever_compression_and_blocks_leave_is_measured_or_refused(side: int, quality: int) -> None:
    try:
        found = labelled(jpeg(blocks(CLEAN, side), quality))
    except SightlineError:
        return
    assert np.median(squares(found)) / np.log(2) < 4  # blocks move rims by a share of their side


@pytest.mark.parametrize(
    "change", [lambda pixels: levels(pixels, 64), lambda pixels: levels(pixels, 32), lambda pixels: banded(pixels, 100)]
)
def test_few_grey_levels_and_constant_areas_leave_the_other_beads(change: Callable[[np.ndarray], np.ndarray]) -> None:
    found = labelled(change(CLEAN))
    assert len(found) > 0.5 * len(TRUTH)
    assert np.median(squares(found)) / np.log(2) < 1.5


def test_an_image_of_few_grey_levels_is_refused_as_such() -> None:
    with pytest.raises(DetectionRefusedError, match=r"most of its field is constant \(2 grey levels"):
        detect(Radiograph(np.where(np.indices(CLEAN.shape)[1] > 255, 150, 50).astype(np.uint8), 255.0))
    with pytest.raises(DetectionRefusedError, match="fewer than 8192 px"):
        detect(Radiograph(CLEAN[:64, :64], 255.0))


@pytest.mark.parametrize("correlation", [-0.2, 0.0, 0.9])
def test_a_broad_mean_has_noise_whatever_the_correlation(correlation: float) -> None:
    noise = NoiseModel(0.0, 1.0, np.array([1.0] + LAGS * [correlation]))
    assert noise.broad == pytest.approx(max(1 + 2 * LAGS * correlation, 0.1))
