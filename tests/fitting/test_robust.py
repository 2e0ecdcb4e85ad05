"""Robust statistics against NumPy's."""

import numpy as np
import pytest

from sightline.common.fitting import median, quantiles


@pytest.mark.parametrize("count", [1, 2, 3, 10, 11, 100])
def test_median_and_quantiles_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).lognormal(size=count)
    assert median(values) == np.median(values)
    shares = (0.0, 0.1, 0.5, 1.0)
    assert quantiles(values, shares) == pytest.approx(np.quantile(values, shares), rel=1e-14)
