"""The noise of an image: its variance at each grey level, and its correlation."""

from dataclasses import dataclass

import cv2
import numpy as np

from sightline.common.fitting import median
from sightline.common.kernels import kernel

BLOCK = 16  # px, four lags; small enough that most blocks of anatomy are nearly planes [ours]
AREA = BLOCK * BLOCK
LAGS = 4  # px; beyond, a detector blur of 0.7-1.2 px leaves a correlation below 3 % [calc]
_SILL = 6  # px; lag at which noise is taken as uncorrelated
_MAX_LAST_CORRELATION = 0.3  # at the last lag; above, the blocks show structure, not noise [ours]
_USUAL_BLUR = 0.9  # px; sigma of an intensifier's blur: 0.22 mm at 0.21-0.3 mm/px [physics.md]
_QUIET = 0.3  # this share of the blocks, the quietest, is taken as free of structure [ours]
_MIN_BLOCKS = 8
_MIN_BROAD = 0.1  # lower limit of `broad`: the sum of estimated correlations may even be negative [ours]
MIN_FIELD_PX = _MIN_BLOCKS * (2 * BLOCK) ** 2  # every second block along either axis counts
_MIN_CHANGES = 7  # neighbours in a row of a block that differ, of 240: fewer are stray levels in a constant area [ours]
_ENOUGH_BLOCKS = 24  # with fewer unclipped blocks, clipped ones are used too [ours]


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of the log intensity L: variance exp(`offset` - `slope` L); its correlation is separable.

    `slope` is 1 for quantum noise, 2 for noise added after a linear detector, 0 after a logarithmic one.
    `correlation` (LAGS + 1,) along either axis, from lag 0.
    """

    offset: float
    slope: float
    correlation: np.ndarray

    @property
    def broad(self) -> float:
        """Variance of a mean over many pixels along one axis, times their number, over one pixel's variance."""
        return max(float(1 + 2 * self.correlation[1:].sum()), _MIN_BROAD)

    def variance(self, log_intensity: np.ndarray | float) -> np.ndarray:
        """Return the variance of the log intensity where its mean is `log_intensity`."""
        return np.exp(self.offset - self.slope * np.asarray(log_intensity))


def estimate_noise(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel | None:
    """Return the noise of `log_image` (H, W) float32 from quiet blocks inside `mask`; None with too few blocks.

    Constant blocks do not count: clipping, compression or too few grey levels have removed their noise.
    """
    level, gamma = _clean_variograms(log_image, mask)
    if len(level) < _MIN_BLOCKS:
        return None
    offset, slope = _quiet_line(level, np.log(gamma[:, -1]))
    ratio = np.log(gamma[:, -1]) - (offset - slope * level)
    quiet = gamma[np.abs(ratio) < 0.35]
    mean = (quiet / quiet[:, -1:]).mean(axis=0) if len(quiet) else np.ones(gamma.shape[1])
    if 1 - mean[-2] / mean[-1] > _MAX_LAST_CORRELATION:
        return _noise_of_a_pattern(log_image, mask)
    # Growth beyond the last lag comes from smooth structure, quadratic in the lag; it is subtracted.
    growth = max(mean[-1] - mean[-2], 0.0) / (_SILL**2 - LAGS**2)
    mean = mean - growth * np.append(np.arange(1, LAGS + 1), _SILL) ** 2
    offset += float(np.log(max(mean[-1], 0.3)))
    correlation = np.concatenate([[1.0], np.clip(1 - mean[:-1] / mean[-1], -0.2, 0.98)])
    return NoiseModel(offset, slope, correlation)


def _clean_variograms(log_image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `_variograms` of blocks with noise; blocks with clipped pixels are left out if enough others remain."""
    level, brightest, changes, gamma = _variograms(log_image, mask)
    noisy = (changes >= _MIN_CHANGES) & (gamma[:, 0] > 0) & (gamma[:, -1] > 0)
    clean = noisy & (brightest < brightest.max(initial=-np.inf))
    keep = clean if np.count_nonzero(clean) >= _ENOUGH_BLOCKS else noisy
    return level[keep], gamma[keep]


def _noise_of_a_pattern(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel | None:
    """Return the noise where no block is flat (a perforated plate): from fourth differences and the usual blur."""
    correlation = np.exp(-((np.arange(LAGS + 1) / _USUAL_BLUR) ** 2) / 4)
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    rough = np.abs(cv2.filter2D(log_image, -1, kernel)[mask])
    gain = 6 - 8 * correlation[1] + 2 * correlation[2]  # of the variance by (1, -2, 1), per axis
    rough = rough[rough > 0]  # compression leaves flat areas without noise
    if not rough.size:
        return None
    sd = float(np.median(rough)) / 0.6745 / gain
    level = float(np.median(log_image[mask]))
    return NoiseModel(2 * np.log(sd) + level, 1.0, correlation)


def _quiet_line(level: np.ndarray, log_variance: np.ndarray) -> tuple[float, float]:
    """Return offset and slope of log variance = offset - slope level through the quiet quantile of ten grey classes."""
    order = np.argsort(level)
    classes = np.array_split(order, min(10, max(1, len(order) // 8)))
    x = np.array([level[c].mean() for c in classes])
    y = np.array([np.interp(_QUIET * (len(c) - 1), np.arange(len(c)), np.sort(log_variance[c])) for c in classes])
    y += 0.1  # the quantile of pure noise lies this far below its mean [calc: 16 px blocks, correlated noise]
    apart = x - x.mean()
    slope = float(np.clip(-(apart @ y) / (apart @ apart), 0.0, 2.0)) if np.ptp(x) > 0.3 else 1.0
    return median(y + slope * x), slope


@kernel(nogil=True)
def _variograms(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return each block's mean level, largest value, number of neighbours along its rows that differ, and half mean
    squared difference at lags 1..LAGS and the sill.

    A plane is subtracted from each block before differences are taken. Every second block along either axis counts,
    if it lies inside the mask.
    """
    step = 2 * BLOCK
    rows, columns = (image.shape[0] + BLOCK) // step, (image.shape[1] + BLOCK) // step
    level, brightest, changes = np.empty(rows * columns), np.empty(rows * columns), np.zeros(rows * columns)
    gamma = np.empty((rows * columns, LAGS + 1))
    block, transposed, sums = np.empty(AREA, np.float32), np.empty(AREA, np.float32), np.empty((3, BLOCK), np.float32)
    n = 0
    for b in range(rows * columns):
        top, left = (b // columns) * step, (b % columns) * step
        if not all_usable(image, mask, top, left, BLOCK, np.inf):
            continue
        for i in range(BLOCK):
            values, row = image[top + i, left : left + BLOCK], block[BLOCK * i : BLOCK * i + BLOCK]
            for j in range(len(values)):
                row[j] = values[j]
            for j in range(1, BLOCK):
                changes[n] += row[j] != row[j - 1]
        level[n], brightest[n] = flatten(block, transposed, sums), sums[2, 0]
        for j in range(1, BLOCK):
            brightest[n] = max(brightest[n], sums[2, j])
        for k in range(LAGS + 1):
            lag = k + 1 if k < LAGS else _SILL
            gamma[n, k] = _squares(block, BLOCK * lag, sums[0]) + _squares(transposed, BLOCK * lag, sums[0])
            gamma[n, k] /= 4.0 * BLOCK * (BLOCK - lag)
        n += 1
    return level[:n], brightest[:n], changes[:n], gamma[:n]


@kernel()
def all_usable(image, mask, top, left, side, ceiling) -> bool:  # noqa: PLR0917 - a kernel
    """Return whether the pixels of a square are all inside the mask and below `ceiling`."""
    for i in range(top, top + side):
        known, values, inside = mask[i, left : left + side], image[i, left : left + side], np.uint8(1)
        for j in range(len(values)):
            inside &= np.uint8(known[j]) & np.uint8(values[j] < ceiling)
        if not inside:
            return False
    return True


@kernel()
def flatten(block, transposed, sums) -> float:
    """Subtract a plane from a `block` (AREA,) and write its transpose to `transposed`; return its mean.

    `sums` (3, BLOCK) receives each column's sum, its sum weighted by the rows' distance from the middle, and its
    largest value. Columns are summed side by side, which the compiler vectorises.
    """
    half, norm = np.float32(0.5 * (BLOCK - 1)), BLOCK * BLOCK * (BLOCK * BLOCK - 1) / 12.0
    total, weighted, largest = sums[0], sums[1], sums[2]
    total[:], weighted[:], largest[:] = 0.0, 0.0, -np.inf
    for i in range(BLOCK):
        row, y = block[BLOCK * i : BLOCK * i + BLOCK], np.float32(i) - half
        for j in range(len(row)):
            total[j] += row[j]
            weighted[j] += y * row[j]
            largest[j] = max(largest[j], row[j])
    mean = su = sv = 0.0
    for j in range(BLOCK):
        mean += total[j]
        su += total[j] * (j - half)
        sv += weighted[j]
    mean, su, sv = mean / AREA, su / norm, sv / norm
    for i in range(BLOCK):
        row, level, slope = block[BLOCK * i : BLOCK * i + BLOCK], np.float32(mean + sv * (i - half)), np.float32(su)
        for j in range(len(row)):
            row[j] -= level + slope * (np.float32(j) - half)
    for i in range(BLOCK):
        for j in range(BLOCK):
            transposed[BLOCK * j + i] = block[BLOCK * i + j]
    return mean


@kernel()
def _squares(values, lag, sums):
    """Return the sum of squared differences of `values` (AREA,) `lag` apart, a multiple of BLOCK.

    Columns are summed side by side in `sums` (BLOCK,), which the compiler vectorises.
    """
    sums[:] = 0.0
    for first in range(0, AREA - lag, BLOCK):
        for j in range(BLOCK):
            change = values[first + lag + j] - values[first + j]
            sums[j] += change * change
    total = 0.0
    for j in range(BLOCK):
        total += sums[j]
    return total
