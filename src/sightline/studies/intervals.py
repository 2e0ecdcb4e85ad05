"""Estimates from many trials with 95 % intervals. Only `rms` assumes a distribution: a normal one, of a mean."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import beta, binom

from sightline.geometry.covariance import TWO_SIDED_95
from sightline.studies.study import Estimate

_TAIL = 0.025


def quantile(name: str, values: np.ndarray, at: float, unit: str = "mm") -> Estimate:
    """Estimate the `at` quantile of independent values (N,), with order statistics as the 95 % interval.

    An end of the interval is None if N is too small.
    """
    ordered, n = np.sort(np.asarray(values, dtype=np.float64)), len(values)
    if n == 0:
        return Estimate(name, None, None, None, unit, 0)
    low, high = int(binom.ppf(_TAIL, n, at)) - 1, int(binom.ppf(1 - _TAIL, n, at))
    ends = [float(ordered[k]) if 0 <= k < n else None for k in (low, high)]
    return Estimate(name, float(np.quantile(ordered, at)), ends[0], ends[1], unit, n)


def share(name: str, hits: np.ndarray) -> Estimate:
    """Estimate the share of true values (N,), with the Clopper-Pearson interval."""
    n, k = len(hits), int(np.sum(hits))
    if n == 0:
        return Estimate(name, None, None, None, "", 0)
    low = float(beta.ppf(_TAIL, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(1 - _TAIL, k + 1, n - k)) if k < n else 1.0
    return Estimate(name, k / n, low, high, "", n)


def rms(name: str, groups: Sequence[np.ndarray], unit: str = "") -> Estimate:
    """Estimate the root mean square of all values, with a normal interval of the mean square over the trials.

    `groups`: the values of each trial, which may depend on each other.
    """
    kept = [np.mean(np.square(group)) for group in groups if len(group)]
    sizes = [len(group) for group in groups if len(group)]
    if not kept:
        return Estimate(name, None, None, None, unit, 0)
    weights = np.array(sizes) / np.sum(sizes)
    mean = float(weights @ kept)
    if len(kept) < 2:
        return Estimate(name, float(np.sqrt(mean)), None, None, unit, len(kept))
    half = TWO_SIDED_95 * float(np.sqrt(np.sum((weights * (np.array(kept) - mean)) ** 2) * len(kept) / (len(kept) - 1)))
    return Estimate(
        name, float(np.sqrt(mean)), float(np.sqrt(max(mean - half, 0.0))), float(np.sqrt(mean + half)), unit, len(kept)
    )
