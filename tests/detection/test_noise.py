"""The estimated noise of an image, against Poisson counts with a known blur."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from bead_images import Bead, grid, transmission

from sightline.detection.beads import refine as sharpen
from sightline.detection.beads.noise import BLOCK, LAGS, NoiseModel, estimate_noise

SIZE = 512
GAIN = 8.0  # grey levels per quantum


def kernel(blur_px: float) -> np.ndarray:
    return cv2.getGaussianKernel(2 * int(np.ceil(4 * blur_px)) + 1, blur_px)[:, 0]


def blurred(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT)


def covariance_by_lag(taps: np.ndarray, lags: int) -> np.ndarray:
    """Return the covariance of filtered white noise of variance 1, along one axis, at lags 0..lags."""
    both = np.pad(np.convolve(taps, taps[::-1]), lags)
    return both[len(both) // 2 :][: lags + 1]


def vignetting(dose: float) -> np.ndarray:
    """Return quanta per pixel that fall to a fifth across the image."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return dose * np.exp(-1.6 * (0.7 * x + 0.3 * y))


def log_counts(expected: np.ndarray, blur_px: float, rng: np.random.Generator) -> np.ndarray:
    counts = rng.poisson(expected).astype(np.float64)
    return np.log(GAIN * blurred(counts, kernel(blur_px))).astype(np.float32)


def everywhere(image: np.ndarray) -> np.ndarray:
    return np.ones(image.shape, dtype=bool)


def found(image: np.ndarray, mask: np.ndarray | None = None) -> NoiseModel:
    noise = estimate_noise(image, everywhere(image) if mask is None else mask)
    assert noise is not None
    return noise


def lost_to_planes(blur_px: float) -> float:
    """Return the share of the variance that fitting a plane removes from a block of few independent values."""
    return 3 * 4 * np.pi * blur_px**2 / BLOCK**2


def assert_variance(noise: NoiseModel, level: np.ndarray, truth: np.ndarray, blur_px: float) -> None:
    """Subtracting planes may remove up to `lost_to_planes`; 0.1 is three standard errors of 256 blocks."""
    share = noise.variance(level) / truth
    assert share.min() > 1 - lost_to_planes(blur_px) - 0.1
    assert share.max() < 1 + 0.1


@pytest.mark.parametrize("blur_px", [0.5, 0.9, 1.2])
@pytest.mark.parametrize("dose", [60.0, 250.0, 1000.0])
def test_poisson_noise_behind_a_blur(blur_px: float, dose: float) -> None:
    expected = vignetting(dose)
    noise = found(log_counts(expected, blur_px, np.random.default_rng(1)))
    white = covariance_by_lag(kernel(blur_px), LAGS)
    level = np.quantile(np.log(GAIN * expected), [0.05, 0.5, 0.95])
    assert_variance(noise, level, white[0] ** 2 * GAIN / np.exp(level), blur_px)
    assert noise.correlation[0] == 1.0
    # A variance that lacks a share lacks as much at every lag. 0.03: three standard errors.
    np.testing.assert_allclose(noise.correlation, white / white[0], atol=lost_to_planes(blur_px) + 0.03)


@pytest.mark.parametrize(
    ("slope", "spread"),
    [
        pytest.param(2.0, lambda light: 6.0 / light, id="added after a linear detector"),
        pytest.param(1.0, lambda light: 0.6 / np.sqrt(light), id="quanta"),
        pytest.param(0.0, lambda light: np.full(light.shape, 0.02), id="a logarithmic detector"),
    ],
)
def test_the_law_of_the_noise_is_told(slope: float, spread: Callable[[np.ndarray], np.ndarray]) -> None:
    light = vignetting(2000.0)
    drawn = blurred(np.random.default_rng(2).standard_normal(light.shape), kernel(0.9))
    sd = spread(light)
    noise = found((np.log(light) + sd * drawn).astype(np.float32))
    # Ten classes of 25 blocks over 1.3 of log intensity: 0.08 is the standard error (0.04-0.1 in twelve images each).
    assert noise.slope == pytest.approx(slope, abs=0.3)
    middle = np.median(np.log(light))
    truth = spread(np.exp(np.array([middle]))) ** 2 * covariance_by_lag(kernel(0.9), 0)[0] ** 2
    assert_variance(noise, np.array([middle]), truth, 0.9)


def test_beads_edges_and_bone_do_not_count_as_noise() -> None:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:SIZE, :SIZE]
    expected = vignetting(400.0) * np.exp(-0.4 * np.sin(x / 23.0) * np.cos(y / 31.0) - 0.8 * (x + 0.3 * y > 300))
    for u, v in grid(64, SIZE, rng):
        expected *= transmission(Bead(u, v, 8.0), expected.shape)
    noise = found(log_counts(expected, 0.9, rng))
    level = np.array([np.log(GAIN * 150.0)])
    truth = covariance_by_lag(kernel(0.9), 0)[0] ** 2 * GAIN / np.exp(level)
    # Three of four blocks hold something: the quiet ones that are left are fewer, and some hold a little of it.
    assert 1 - lost_to_planes(0.9) - 0.1 < float((noise.variance(level) / truth)[0]) < 1.3


def test_where_everything_is_a_pattern_the_usual_blur_is_taken() -> None:
    """In a perforated plate no block is flat, and the holes' correlation must not be taken for the noise's."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:SIZE, :SIZE] % 17 - 8.3
    noise = found(log_counts(np.where(x**2 + y**2 < 25, 1500.0, 500.0), 0.9, rng))
    white = covariance_by_lag(kernel(0.9), LAGS)
    np.testing.assert_allclose(noise.correlation, white / white[0], atol=0.01)


def test_clipped_blocks_do_not_count_and_what_lies_outside_the_mask_does_not_matter() -> None:
    """Clipping reduces the noise, down to zero."""
    expected = vignetting(400.0)
    image = log_counts(expected, 0.9, np.random.default_rng(5))
    white = np.float32(np.quantile(image, 0.6))
    image = np.minimum(image, white)
    mask = everywhere(image)
    mask[:, SIZE - 100 :] = False
    noise = found(image, mask)
    level = np.quantile(image[mask & (image < white)], [0.1, 0.5])
    assert_variance(noise, level, covariance_by_lag(kernel(0.9), 0)[0] ** 2 * GAIN / np.exp(level), 0.9)
    image[~mask] = white * np.float32(1.000001)  # what a filled-in border may come to by rounding
    again = found(image, mask)
    assert (again.offset, again.slope) == (noise.offset, noise.slope)


def test_areas_of_one_grey_level_do_not_count_also_with_a_stray_level_here_and_there() -> None:
    """As bars of a video have, and what compression leaves of its edges."""
    image = log_counts(vignetting(400.0), 0.9, np.random.default_rng(5))
    image[:, : SIZE // 2] = np.log(255.0)
    image[5::32, 5:256:32] = np.log(256.0)
    mask = everywhere(image)
    mask[:, : SIZE // 2] = False
    noise, own = found(image), found(image, mask)
    assert (noise.offset, noise.slope) == (own.offset, own.slope)
    designs = [sharpen.design(image, where, noise) for where in (everywhere(image), mask)]
    assert designs[0].gain == designs[1].gain
    assert np.fft.rfft(np.concatenate([designs[0].correlation, designs[0].correlation[:0:-1]])).real.min() > 0


@pytest.mark.parametrize("side", [15, 16, 60])
def test_too_small_a_field_has_no_noise_to_measure(side: int) -> None:
    """An estimate needs at least eight blocks; every second one counts, so 60 px hold four."""
    image = log_counts(vignetting(400.0), 0.9, np.random.default_rng(6))
    mask = np.zeros(image.shape, dtype=bool)
    mask[:side, :side] = True
    assert estimate_noise(image, mask) is None


def test_an_image_without_noise_has_none_to_measure() -> None:
    flat = np.full((SIZE, SIZE), 6.0, np.float32)
    assert estimate_noise(flat, everywhere(flat)) is None


@pytest.mark.parametrize("blur_px", [0.5, 0.9, 1.2])
def test_sharpening_does_to_the_noise_what_it_says(blur_px: float) -> None:
    expected = vignetting(250.0)
    image = log_counts(expected, blur_px, np.random.default_rng(7))
    noise = found(image)
    design = sharpen.design(image, everywhere(image), noise)
    whole = np.concatenate([design.taps[:0:-1], design.taps])
    after = covariance_by_lag(np.convolve(kernel(blur_px), whole), sharpen.AFTER_LAGS)
    level = np.log(GAIN * np.median(expected))
    truth = after[0] ** 2 * GAIN / np.exp(level)
    # Of the fit's weights 15 % in variance are 7 % in the stated error of a centre.
    assert float(noise.variance(level)) * design.gain == pytest.approx(truth, rel=0.15)
    np.testing.assert_allclose(design.correlation, after / after[0], atol=lost_to_planes(blur_px) * 0.5 + 0.03)
    assert whole.sum() == pytest.approx(1.0, abs=1e-3)  # levels stay


@pytest.mark.parametrize("blur_px", [0.7, 0.9, 1.2])
def test_sharpening_turns_the_blur_into_the_one_it_says(blur_px: float) -> None:
    """Second moments of filters add; the blur estimated from the noise's correlation is low by 0.05-0.1."""
    image = log_counts(vignetting(250.0), blur_px, np.random.default_rng(8))
    design = sharpen.design(image, everywhere(image), found(image))
    at = np.arange(1, sharpen.TAPS + 1)
    assert blur_px**2 + design.blur2_px2 == pytest.approx(0.25, abs=0.1 * blur_px**2 + 0.05)
    assert 2 * (design.taps[1:] * at**2).sum() < 0
    assert design.gain > 1


def test_noise_that_is_white_is_left_as_it_is() -> None:
    image = np.log(np.random.default_rng(9).poisson(vignetting(400.0))).astype(np.float32)
    design = sharpen.design(image, everywhere(image), found(image))
    assert design.taps.tolist() == [1.0] + sharpen.TAPS * [0.0]
    assert design.gain == pytest.approx(1.0, abs=0.1)


def test_without_quiet_blocks_sharpening_is_computed_from_the_blur_alone() -> None:
    image = log_counts(vignetting(250.0), 0.9, np.random.default_rng(10))
    noise = found(image)
    mask = np.zeros(image.shape, dtype=bool)
    mask[:40, :40] = True
    alone, seen = (sharpen.design(image, where, noise) for where in (mask, everywhere(image)))
    np.testing.assert_array_equal(alone.taps, seen.taps)
    assert alone.gain == pytest.approx(seen.gain, rel=0.15)
    np.testing.assert_allclose(alone.correlation, seen.correlation, atol=0.1)
