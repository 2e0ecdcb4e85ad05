"""Intervals hold what they say, by sampling; and known small cases."""

import numpy as np
import pytest
from scipy.stats import binomtest

from sightline.studies.runs.study import quantile, rms, share


def test_a_quantile_lies_between_its_order_statistics():
    figure = quantile("x", np.arange(1, 11), 0.5)  # for 10 numbers: the 2nd and the 9th hold the median with 97.9 %
    assert (figure.value, figure.low, figure.high, figure.number) == (5.5, 2.0, 9.0, 10)
    few = quantile("x", np.array([3.0, 1.0]), 0.95)
    assert (few.low, few.high) == (1.0, None)
    assert quantile("x", np.zeros(0), 0.5).value is None


@pytest.mark.parametrize("at", [0.5, 0.95])
def test_quantile_intervals_hold_the_true_quantile(at):
    rng = np.random.default_rng(1)
    true = np.log(1 / (1 - at))  # of an exponential distribution
    drawn = [quantile("x", rng.exponential(size=101), at) for _ in range(2000)]
    held = [(f.low is None or f.low <= true) and (f.high is None or true <= f.high) for f in drawn]
    # At least 95 %, less three standard deviations of 2,000 draws; discrete, so it may be more.
    assert 0.935 <= np.mean(held) <= 0.99


def test_a_share_has_the_exact_binomial_interval():
    for k, n in ((0, 7), (3, 7), (7, 7), (95, 100)):
        figure = share("x", np.arange(n) < k)
        exact = binomtest(k, n).proportion_ci(method="exact")
        assert figure.value == k / n
        assert (figure.low, figure.high) == (pytest.approx(exact.low), pytest.approx(exact.high))
    assert share("x", np.zeros(0, dtype=bool)).value is None


def test_rms_counts_values_alike_and_trials_as_what_varies():
    figure = rms("x", [np.array([3.0, 4.0]), np.array([5.0])])
    assert figure.value == pytest.approx(np.sqrt(50 / 3))
    assert rms("x", [np.array([2.0])]).low is None
    assert rms("x", []).value is None
    rng = np.random.default_rng(2)
    held = []
    for _ in range(1000):
        common = rng.standard_normal((80, 1))  # four values of a trial share half of their variance
        values = np.sqrt(0.5) * common + np.sqrt(0.5) * rng.standard_normal((80, 4))
        interval = rms("x", list(values))
        held.append(interval.low <= 1.0 <= interval.high)
    assert 0.92 <= np.mean(held) <= 0.97  # 95 %, less what 80 trials of a skew square miss
