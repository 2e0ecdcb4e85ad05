"""Statistics that a few wrong values do not move."""

import numpy as np

MEDIAN_M2 = 1.386  # of chi-square with two degrees of freedom, 2 ln 2; another digit would move stored estimates
MAD_TO_SD = 1.4826  # s.d. of a normal distribution over its median absolute deviation


def median(values: np.ndarray) -> float:
    """Of (N,), as np.median, which takes ten times as long on a hundred."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def variance_ratio(m2: np.ndarray) -> float:
    """By what factor the variances of two-dimensional errors exceed what is stated, from the (N,) squared Mahalanobis
    lengths of the errors."""
    return median(m2) / MEDIAN_M2
