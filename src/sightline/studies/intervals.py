"""Figures of many trials, each with its 95 % interval. None of them assumes a distribution but `rms`'s, of a mean."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import beta, binom

from sightline.geometry.covariance import TWO_SIDED_95
from sightline.studies.study import Figure

_TAIL = 0.025


def quantile(name: str, values: np.ndarray, at: float, unit: str = "mm") -> Figure:
    """The `at` quantile of independent values (N,), between order statistics that hold the true one with 95 %.

    An end of the interval is None where N is too small to give one.
    """
    ordered, n = np.sort(np.asarray(values, dtype=np.float64)), len(values)
    if n == 0:
        return Figure(name, None, None, None, unit, 0)
    low, high = int(binom.ppf(_TAIL, n, at)) - 1, int(binom.ppf(1 - _TAIL, n, at))
    ends = [float(ordered[k]) if 0 <= k < n else None for k in (low, high)]
    return Figure(name, float(np.quantile(ordered, at)), ends[0], ends[1], unit, n)


def share(name: str, hits: np.ndarray) -> Figure:
    """The share of trials that are true (N,), with Clopper and Pearson's interval."""
    n, k = len(hits), int(np.sum(hits))
    if n == 0:
        return Figure(name, None, None, None, "", 0)
    low = float(beta.ppf(_TAIL, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(1 - _TAIL, k + 1, n - k)) if k < n else 1.0
    return Figure(name, k / n, low, high, "", n)


def rms(name: str, groups: Sequence[np.ndarray], unit: str = "") -> Figure:
    """Root mean square of all values; `groups`: those of one trial, which depend on each other. Normal interval of
    the mean square over the trials."""
    kept = [np.mean(np.square(group)) for group in groups if len(group)]
    sizes = [len(group) for group in groups if len(group)]
    if not kept:
        return Figure(name, None, None, None, unit, 0)
    weights = np.array(sizes) / np.sum(sizes)
    mean = float(weights @ kept)
    if len(kept) < 2:
        return Figure(name, float(np.sqrt(mean)), None, None, unit, len(kept))
    half = TWO_SIDED_95 * float(np.sqrt(np.sum((weights * (np.array(kept) - mean)) ** 2) * len(kept) / (len(kept) - 1)))
    return Figure(
        name, float(np.sqrt(mean)), float(np.sqrt(max(mean - half, 0.0))), float(np.sqrt(mean + half)), unit, len(kept)
    )
