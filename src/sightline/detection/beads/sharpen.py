"""Sharpening that undoes most of the detector's blur. Quantum noise arises before the blur, so it becomes white."""

from dataclasses import dataclass

import numpy as np

from sightline.common.fitting import quantiles
from sightline.common.kernels import kernel
from sightline.common.threads import in_parts
from sightline.detection.beads.noise import AREA, BLOCK, NoiseModel, flatten
from sightline.detection.beads.window import TAPS, along_both_axes

_WIDE, _STEP = BLOCK + 2 * TAPS, 4 * BLOCK  # px: side of a block with the filter's margin; distance of blocks
AFTER_LAGS = 3  # px, of the noise correlation after sharpening
_LEFT_PX = 0.5  # sigma of the remaining blur: less would amplify electronic and rounding noise [calc]
_WHITE = 0.004  # assumed share of white noise along one axis, the regularisation of the filter [calc]
_MIN_BLOCKS = 16
_MAX_BLUR_PX = 1.6  # more correlation comes from structure, or from a filter that cannot be undone [ours]


@dataclass(frozen=True, eq=False)
class Sharpening:
    """A symmetric filter with `taps` (TAPS + 1,) along both axes.

    It changes a blur of sigma s to sqrt(s² + `blur2_px2`) (negative), multiplies the noise's variance by `gain`, and
    leaves noise with `correlation` (AFTER_LAGS + 1,) along either axis.
    """

    taps: np.ndarray
    blur2_px2: float
    gain: float
    correlation: np.ndarray


def design(log_image: np.ndarray, mask: np.ndarray, noise: NoiseModel) -> Sharpening:
    """Return the sharpening for the image's noise; gain and correlation are measured in the image's quiet blocks."""
    blur = noise_blur_px(noise)
    if blur <= _LEFT_PX:
        taps, left = np.eye(TAPS + 1)[0], blur
    else:
        taps, left = _taps(blur), _LEFT_PX
    gamma = _correlations_after(log_image, mask, noise, taps)
    gamma = gamma[gamma[:, 0] > 0]
    if len(gamma) < _MIN_BLOCKS:
        return Sharpening(taps, left**2 - blur**2, *_of_gaussian_noise(taps, blur))
    # Selecting the quiet blocks lowers the estimate by 8 %; residual structure makes up for it [twin].
    low, high = quantiles(gamma[:, 0], (0.1, 0.5))
    mean = _with_planes(gamma[(gamma[:, 0] >= low) & (gamma[:, 0] <= high)].mean(axis=0))
    return Sharpening(taps, left**2 - blur**2, float(mean[0]), np.clip(mean / mean[0], -0.5, 1.0))


def _with_planes(covariance: np.ndarray) -> np.ndarray:
    """Return covariances by lag, corrected for the planes subtracted from the blocks: three terms of slow noise."""
    whole = covariance
    for _ in range(4):
        slow = max(float(whole[0] + 2 * whole[1:].sum()), 0.0) ** 2 / float(whole[0])
        whole = covariance + 3 / BLOCK**2 * slow
    return whole


def noise_blur_px(noise: NoiseModel) -> float:
    """Return the sigma, px, of the Gaussian blur of formerly white noise, whose correlation is exp(-d² / 4 sigma²)."""
    first = float(np.clip(noise.correlation[1], 1e-3, np.exp(-0.25 / _MAX_BLUR_PX**2)))
    return 0.5 / float(np.sqrt(-np.log(first)))


def _of_gaussian_noise(taps: np.ndarray, blur: float) -> tuple[float, np.ndarray]:
    """Return gain and correlation for white noise blurred by `blur`, used where no block is quiet."""
    whole = np.concatenate([taps[:0:-1], taps])
    both = np.convolve(whole, whole)
    at = np.arange(len(both)) - len(both) // 2
    after = both @ np.exp(-(np.subtract.outer(at, np.arange(AFTER_LAGS + 1)) ** 2) / (4 * blur**2))
    return float(after[0] ** 2), after / after[0]


def _taps(blur: float) -> np.ndarray:
    """Return least-squares taps, with sum 1, that change a Gaussian of sigma `blur` to one of _LEFT_PX."""
    k = np.linspace(0, np.pi, 200)
    waves = np.cos(np.outer(k, np.arange(TAPS + 1))) * np.append(1.0, np.full(TAPS, 2.0))
    have, want = np.exp(-0.5 * (k * blur) ** 2), np.exp(-0.5 * (k * _LEFT_PX) ** 2)
    A = (waves * have[:, None] ** 2).T @ waves + _WHITE * waves.T @ waves + 1e4 * np.outer(waves[0], waves[0])
    return np.linalg.solve(A, waves.T @ (have * want) + 1e4 * waves[0])


def _correlations_after(image: np.ndarray, mask: np.ndarray, noise: NoiseModel, taps: np.ndarray) -> np.ndarray:
    """Return covariances (N, AFTER_LAGS + 1) by lag after sharpening, for every fourth block along either axis.

    In units of the noise's variance; 0 for blocks with an unusable pixel.
    """
    rows, columns = (max((side - _WIDE) // _STEP + 1, 0) for side in image.shape)
    out = np.zeros((rows * columns, AFTER_LAGS + 1))
    line = np.array([noise.offset, noise.slope])
    in_parts(_correlations_part, image, mask, line, taps.astype(np.float32), float(image.max()), columns, out)
    return out


@kernel(nogil=True)
def _correlations_part(part, parts, image, mask, line, taps, ceiling, columns, out):  # noqa: PLR0917
    block, transposed, sums = np.empty(AREA, np.float32), np.empty(AREA, np.float32), np.empty((3, BLOCK), np.float32)
    for b in range(part, len(out), parts):
        top, left = (b // columns) * _STEP, (b % columns) * _STEP
        if not _usable(image, mask, top, left, ceiling):
            continue
        sharp = along_both_axes(image[top : top + _WIDE, left : left + _WIDE].copy(), taps)
        for i in range(BLOCK):
            for j in range(BLOCK):
                block[BLOCK * i + j] = sharp[i, j]
        variance = np.exp(line[0] - line[1] * flatten(block, transposed, sums))
        for lag in range(AFTER_LAGS + 1):
            total = _products(block, BLOCK * lag, sums[0]) + _products(transposed, BLOCK * lag, sums[0])
            out[b, lag] = total / (2.0 * BLOCK * (BLOCK - lag)) / variance


@kernel()
def _usable(image, mask, top, left, ceiling) -> bool:
    """Return whether the pixels of a block and its margin are all in the field and none is clipped."""
    for i in range(top, top + _WIDE):
        known, values, inside = mask[i, left : left + _WIDE], image[i, left : left + _WIDE], np.uint8(1)
        for j in range(_WIDE):
            inside &= np.uint8(known[j]) & np.uint8(values[j] < ceiling)
        if not inside:
            return False
    return True


@kernel()
def _products(values, lag, sums):
    """Return the sum of products of `values` (AREA,) `lag` apart, a multiple of BLOCK.

    Columns are summed side by side in `sums` (BLOCK,), which the compiler vectorises.
    """
    sums[:] = 0.0
    for first in range(0, AREA - lag, BLOCK):
        for j in range(BLOCK):
            sums[j] += values[first + lag + j] * values[first + j]
    total = 0.0
    for j in range(BLOCK):
        total += sums[j]
    return total
