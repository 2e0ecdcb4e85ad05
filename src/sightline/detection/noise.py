"""The image's own noise: how strong it is at each grey level, and how far it is correlated."""

from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

BLOCK = 16  # px; small enough that anatomy is a plane over most blocks [ours]
LAGS = 4  # px; a detector blur of 0.7-1.2 px leaves a correlation below 3 % beyond [calc]
_SILL = 6  # px; lag at which noise counts as uncorrelated
_NO_FLAT_AREA = 0.3  # correlation at the last lag above which the blocks hold structure, not noise [ours]
_USUAL_BLUR = 0.9  # px; sigma of an intensifier's blur: 0.22 mm at 0.21-0.3 mm/px [physics.md]
_QUIET = 0.3  # the quietest share of the blocks is taken as free of structure [ours]
_FEWEST_BLOCKS = 8
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

    def variance(self, log_intensity: np.ndarray | float) -> np.ndarray:
        """Variance of the log intensity where its mean is `log_intensity`."""
        return np.exp(self.offset - self.slope * np.asarray(log_intensity))


def estimate_noise(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel | None:
    """Noise of `log_image` (H, W) float32 from its quiet blocks inside `mask`; None if no block lies inside."""
    level, gamma = _clean_variograms(log_image, mask)
    if len(level) < _FEWEST_BLOCKS:
        return None
    offset, slope = _quiet_line(level, np.log(gamma[:, -1]))
    ratio = np.log(gamma[:, -1]) - (offset - slope * level)
    quiet = gamma[np.abs(ratio) < 0.35]
    mean = (quiet / quiet[:, -1:]).mean(axis=0) if len(quiet) else np.ones(gamma.shape[1])
    structured = 1 - mean[-2] / mean[-1] > _NO_FLAT_AREA
    # What grows beyond the last lag is structure, smooth and therefore quadratic in the lag: it is taken off.
    growth = max(mean[-1] - mean[-2], 0.0) / (_SILL**2 - LAGS**2)
    mean = mean - growth * np.append(np.arange(1, LAGS + 1), _SILL) ** 2
    offset += float(np.log(max(mean[-1], 0.3)))
    correlation = np.concatenate([[1.0], np.clip(1 - mean[:-1] / mean[-1], -0.2, 0.98)])
    if structured:
        return _noise_of_a_pattern(log_image, mask)
    return NoiseModel(offset, slope, correlation)


def _clean_variograms(log_image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`_variograms` of the blocks that have noise; with those where some pixels are clipped only if all are."""
    level, gamma = np.empty(0), np.empty((0, LAGS + 1))
    for ceiling in (float(log_image.max()), np.inf):
        level, gamma = _variograms(log_image, mask, ceiling)
        keep = (level > -np.inf) & (gamma[:, 0] > 0) & (gamma[:, -1] > 0)
        level, gamma = level[keep], gamma[keep]
        if len(level) >= _ENOUGH_BLOCKS:
            break
    return level, gamma


def _noise_of_a_pattern(log_image: np.ndarray, mask: np.ndarray) -> NoiseModel:
    """Noise where no block is flat (a perforated plate): from mixed fourth differences and the usual blur."""
    correlation = np.exp(-((np.arange(LAGS + 1) / _USUAL_BLUR) ** 2) / 4)
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    rough = np.abs(cv2.filter2D(log_image, -1, kernel)[mask])
    gain = 6 - 8 * correlation[1] + 2 * correlation[2]  # variance that (1, -2, 1) leaves, per axis
    sd = float(np.median(rough)) / 0.6745 / gain
    level = float(np.median(log_image[mask]))
    return NoiseModel(2 * np.log(sd) + level, 1.0, correlation)


def _quiet_line(level: np.ndarray, log_variance: np.ndarray) -> tuple[float, float]:
    """Lower envelope log variance = offset - slope level, a line through the quiet quantile of ten grey classes."""
    order = np.argsort(level)
    classes = np.array_split(order, min(10, max(1, len(order) // 8)))
    x = np.array([level[c].mean() for c in classes])
    y = np.array([np.quantile(log_variance[c], _QUIET) for c in classes])
    y = y + 0.1  # the quantile of pure noise lies this far under its mean [calc: 16 px blocks, correlated noise]
    spread = np.ptp(x)
    slope = float(np.clip(-np.polyfit(x, y, 1)[0], 0.0, 2.0)) if spread > 0.3 else 1.0
    return float(np.median(y + slope * x)), slope


@nb.njit(parallel=True, cache=True, fastmath=True)
def _variograms(image: np.ndarray, mask: np.ndarray, ceiling: float) -> tuple[np.ndarray, np.ndarray]:
    """Per block: mean level (-inf if not usable), half mean squared difference at lags 1..LAGS and the sill.

    A plane is taken off first. Pixels at the `ceiling` are clipped. Every second block along either axis counts.
    """
    height, width = image.shape
    rows, cols = (height - BLOCK) // (2 * BLOCK) + 1, (width - BLOCK) // (2 * BLOCK) + 1
    level = np.full(rows * cols, -np.inf)
    gamma = np.zeros((rows * cols, LAGS + 1))
    half = (BLOCK - 1) / 2
    norm = BLOCK * BLOCK * (BLOCK * BLOCK - 1) / 12.0
    for b in nb.prange(rows * cols):
        top, left = (b // cols) * 2 * BLOCK, (b % cols) * 2 * BLOCK
        inside = True
        mean = su = sv = 0.0
        for i in range(BLOCK):
            for j in range(BLOCK):
                value = image[top + i, left + j]
                inside &= mask[top + i, left + j] and value < ceiling
                mean += value
                su += value * (j - half)
                sv += value * (i - half)
        if not inside:
            continue
        level[b] = mean / (BLOCK * BLOCK)
        su, sv = su / norm, sv / norm
        for k in range(LAGS + 1):
            lag = k + 1 if k < LAGS else _SILL
            total = 0.0
            for i in range(BLOCK):
                for j in range(BLOCK - lag):
                    d = image[top + i, left + j + lag] - image[top + i, left + j] - su * lag
                    e = image[top + j + lag, left + i] - image[top + j, left + i] - sv * lag
                    total += d * d + e * e
            gamma[b, k] = total / (4.0 * BLOCK * (BLOCK - lag))
    return level, gamma
