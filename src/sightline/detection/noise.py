"""The image's own noise: how strong it is at each grey level, and how far it is correlated."""

from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

from sightline.detection.compiled import exact, fast

BLOCK = 16  # px; small enough that anatomy is a plane over most blocks [ours]
LAGS = 4  # px; a detector blur of 0.7-1.2 px leaves a correlation below 3 % beyond [calc]
_SILL = 6  # px; lag at which noise counts as uncorrelated
_NO_FLAT_AREA = 0.3  # correlation at the last lag above which the blocks hold structure, not noise [ours]
_USUAL_BLUR = 0.9  # px; sigma of an intensifier's blur: 0.22 mm at 0.21-0.3 mm/px [physics.md]
_QUIET = 0.3  # the quietest share of the blocks is taken as free of structure [ours]
_FEWEST_BLOCKS = 8
_MIN_BROAD = 0.1  # variance of a broad mean along one axis; negative correlations add up to less than noise has [ours]
MIN_FIELD_PX = _FEWEST_BLOCKS * (2 * BLOCK) ** 2  # every second block along either axis counts
_ENOUGH_BLOCKS = 24  # without clipped ones [ours]


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of the log intensity L: variance exp(`offset` - `slope` L), correlation the product of both axes'.

    `slope` is 1 for quanta, 2 for noise added after a linear detector, 0 for a logarithmic one.
    `correlation` (LAGS + 1,) along either axis, lag 0 first.
    """

    offset: float
    slope: float
    correlation: np.ndarray

    @property
    def broad(self) -> float:
        """Variance of a mean over many pixels along one axis, times their number, over that of one pixel."""
        return max(float(1 + 2 * self.correlation[1:].sum()), _MIN_BROAD)

    def variance(self, log_intensity: np.ndarray | float) -> np.ndarray:
        """Variance of the log intensity where its mean is `log_intensity`."""
        return np.exp(self.offset - self.slope * np.asarray(log_intensity))


def estimate_noise(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel | None:
    """Noise of `log_image` (H, W) float32 from its quiet blocks inside `mask`; None if too few blocks have any.

    Constant blocks do not count: clipping, compression or too few grey levels took their noise away.
    """
    level, gamma = _clean_variograms(log_image, mask)
    if len(level) < _FEWEST_BLOCKS:
        return None
    offset, slope = _quiet_line(level, np.log(gamma[:, -1]))
    ratio = np.log(gamma[:, -1]) - (offset - slope * level)
    quiet = gamma[np.abs(ratio) < 0.35]
    mean = (quiet / quiet[:, -1:]).mean(axis=0) if len(quiet) else np.ones(gamma.shape[1])
    if 1 - mean[-2] / mean[-1] > _NO_FLAT_AREA:
        return _noise_of_a_pattern(log_image, mask)
    # What grows beyond the last lag is structure, smooth and therefore quadratic in the lag: it is taken off.
    growth = max(mean[-1] - mean[-2], 0.0) / (_SILL**2 - LAGS**2)
    mean = mean - growth * np.append(np.arange(1, LAGS + 1), _SILL) ** 2
    offset += float(np.log(max(mean[-1], 0.3)))
    correlation = np.concatenate([[1.0], np.clip(1 - mean[:-1] / mean[-1], -0.2, 0.98)])
    return NoiseModel(offset, slope, correlation)


def _clean_variograms(log_image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_variograms` of the blocks that have noise; with those where some pixels are clipped only if all are."""
    level, brightest, gamma = _variograms(log_image, mask)
    noisy = (gamma[:, 0] > 0) & (gamma[:, -1] > 0)
    clean = noisy & (brightest < brightest.max(initial=-np.inf))
    keep = clean if np.count_nonzero(clean) >= _ENOUGH_BLOCKS else noisy
    return level[keep], gamma[keep]


def _noise_of_a_pattern(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel | None:
    """Noise where no block is flat (a perforated plate): from mixed fourth differences and the usual blur."""
    correlation = np.exp(-((np.arange(LAGS + 1) / _USUAL_BLUR) ** 2) / 4)
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    rough = np.abs(cv2.filter2D(log_image, -1, kernel)[mask])
    gain = 6 - 8 * correlation[1] + 2 * correlation[2]  # variance that (1, -2, 1) leaves, per axis
    rough = rough[rough > 0]  # compression leaves flat areas, which hold no noise
    if not rough.size:
        return None
    sd = float(np.median(rough)) / 0.6745 / gain
    level = float(np.median(log_image[mask]))
    return NoiseModel(2 * np.log(sd) + level, 1.0, correlation)


def _quiet_line(level: np.ndarray, log_variance: np.ndarray) -> tuple[float, float]:
    """Lower envelope log variance = offset - slope level, a line through the quiet quantile of ten grey classes."""
    order = np.argsort(level)
    classes = np.array_split(order, min(10, max(1, len(order) // 8)))
    x = np.array([level[c].mean() for c in classes])
    y = np.array([np.interp(_QUIET * (len(c) - 1), np.arange(len(c)), np.sort(log_variance[c])) for c in classes])
    y += 0.1  # the quantile of pure noise lies this far under its mean [calc: 16 px blocks, correlated noise]
    apart = x - x.mean()
    slope = float(np.clip(-(apart @ y) / (apart @ apart), 0.0, 2.0)) if np.ptp(x) > 0.3 else 1.0
    return float(np.median(y + slope * x)), slope


@nb.njit(cache=True, fastmath=True)
def _variograms(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per block inside the mask: mean level, largest value, half mean squared difference at lags 1..LAGS and the sill.

    A plane is taken off for the differences. Every second block along either axis counts.
    """
    step = 2 * BLOCK
    rows, columns = (image.shape[0] + BLOCK) // step, (image.shape[1] + BLOCK) // step
    level, brightest = np.empty(rows * columns), np.empty(rows * columns)
    gamma = np.empty((rows * columns, LAGS + 1))
    block, turned = np.empty(BLOCK * BLOCK, np.float32), np.empty(BLOCK * BLOCK, np.float32)
    n = 0
    for b in range(rows * columns):
        top, left = (b // columns) * step, (b % columns) * step
        if not _copied(image, mask, top, left, block):
            continue
        level[n], brightest[n] = _flatten(block, turned)
        for k in range(LAGS + 1):
            lag = k + 1 if k < LAGS else _SILL
            gamma[n, k] = _squares(block, BLOCK * lag) + _squares(turned, BLOCK * lag)
            gamma[n, k] /= 4.0 * BLOCK * (BLOCK - lag)
        n += 1
    return level[:n], brightest[:n], gamma[:n]


@exact
def _copied(image, mask, top, left, block) -> bool:
    """Whether the block there lies inside the mask; its pixels go to `block`."""
    inside = True
    for i in range(BLOCK):
        values, known = image[top + i, left : left + BLOCK], mask[top + i, left : left + BLOCK]
        row = block[BLOCK * i : BLOCK * i + BLOCK]
        for j in range(BLOCK):
            row[j] = values[j]
            inside &= known[j]
    return inside


@exact
def _flatten(block, turned) -> tuple[float, float]:
    """Take a plane off the pixels of a block; its mean and largest value. `turned`: the same, columns for rows."""
    mean, su, sv, largest = 0.0, 0.0, 0.0, block[0]
    half, norm = (BLOCK - 1) / 2, BLOCK * BLOCK * (BLOCK * BLOCK - 1) / 12.0
    for k in range(BLOCK * BLOCK):
        largest = max(largest, block[k])
        mean += block[k]
        su += block[k] * (k % BLOCK - half)
        sv += block[k] * (k // BLOCK - half)
    mean, su, sv = mean / (BLOCK * BLOCK), su / norm, sv / norm
    for k in range(BLOCK * BLOCK):
        block[k] -= mean + su * (k % BLOCK - half) + sv * (k // BLOCK - half)
    for k in range(BLOCK * BLOCK):
        turned[BLOCK * (k % BLOCK) + k // BLOCK] = block[k]
    return mean, largest


@fast
def _squares(values, lag):
    """Sum of squared differences of what lies `lag` apart: one loop over neighbours, which the compiler vectorises."""
    later, total = values[lag:], np.float32(0)
    for k in range(len(later)):
        total += (later[k] - values[k]) ** 2
    return total
